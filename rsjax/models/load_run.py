"""Loads configuration, weights and trained model of a run directory or a saved model."""

from pathlib import Path

import jax

from rsjax.config import Config, ConfigError, from_dict
from rsjax.data.normalization import Normalization
from rsjax.errors import UserError
from rsjax.files import checked_path
from rsjax.model_directory import SETTINGS, is_saved, load_part, locate, read_settings, saved_section
from rsjax.models.base import Assets, create_autoencoder, create_model
from rsjax.models.trained import TrainedModel
from rsjax.trainable import Params


def load(run: Path | str) -> TrainedModel:
    """Loads the trained world model of a run directory or a saved model, or the one in the package of that name.

    Raises:
        UserError: it is missing, unfinished or damaged, or was made by another version of rsjax.
    """
    run = locate(checked_path(run, "run"))
    config = load_config(run)
    model = create_model(config)
    params = load_part(run, "world_model", jax.eval_shape(lambda: model.init(jax.random.key(0))))
    return TrainedModel(config, model, params, load_assets(config, run), run)


def load_config(run: Path) -> Config:
    """Reads the configuration of a run directory or a saved model.

    Raises:
        UserError: the configuration is missing, damaged or of another version.
    """
    path = run / SETTINGS
    if not path.exists():
        raise UserError(f"{path}: missing, so {run} is not a run directory; make one with rsjax train")
    try:
        return from_dict(Config, read_settings(run, "the train command of this run writes it again"))
    except (ConfigError, TypeError) as error:
        raise UserError(
            f"{path}: not a configuration of this version of rsjax ({error}); if an older one made it, "
            f"python -m scripts.convert_old_run {run} upgrades it; otherwise train the run again with --overwrite"
        ) from error


def load_assets(config: Config, run: Path) -> Assets:
    """Loads the data that the run's world model needs in addition to its own parameters."""
    return Assets(load_normalization(run), load_tokenizer(config, run))


def load_normalization(run: Path) -> Normalization:
    """Loads the numbers that turn a run's units into its model's."""
    if is_saved(run):
        return Normalization.of(saved_section(run).get("normalization"), run / SETTINGS)
    return Normalization.load(run / "tokens")


def load_tokenizer(config: Config, run: Path) -> Params | None:
    """Loads the trained tokenizer's or autoencoder's parameters; None for a model without one."""
    if not config.model.uses_tokenizer:
        return None
    return load_part(run, "tokenizer", create_autoencoder(config).shapes())
