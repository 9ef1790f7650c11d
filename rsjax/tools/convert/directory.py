"""Directories of converted checkpoints, laid out like run directories: ``config.json`` and the weights.

A directory holds a tokenizer, a world model or both; training can start from it (``start_from``), as from a run.
"""

from pathlib import Path
from typing import TypeVar

import jax

from rsjax.config import ModelConfig, TokenizerConfig, to_dict
from rsjax.files import disk_guard, read_json, write_json
from rsjax.model_directory import Part, has_weights, load_part
from rsjax.models.irasim import autoencoder, dit, pretrained
from rsjax.models.irasim.config import KLConfig
from rsjax.models.network_settings import Inputs, read_model, saved_inputs
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.pretrained import read_architecture
from rsjax.models.roboscape.transformer import Transformer
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tokenizers.training import read_tokenizer_config
from rsjax.tools.convert.files import ConvertError
from rsjax.trainable import Params
from rsjax.training.checkpoint import save_weights

M = TypeVar("M", bound=ModelConfig)

SECTIONS: dict[type, tuple[str, str]] = {  # configuration → (section of config.json, directory of the weights)
    TokenizerConfig: ("tokenizer", "tokenizer/weights"),
    Architecture: ("architecture", "world_model/weights"),
    KLConfig: (pretrained.AUTOENCODER, "tokenizer/weights"),
    dit.Architecture: (pretrained.NETWORK, "world_model/weights"),
}


def save(directory: Path, config: TokenizerConfig | Architecture | KLConfig | dit.Architecture, params: Params) -> bool:
    """Writes a tokenizer or a world model, replacing one that is there; the directory's other network is kept.

    Returns:
        Whether it replaced one.

    Raises:
        ConvertError: the directory is a run's, so its weights were trained there.
        FileError: the disk is full.
    """
    (section, place) = SECTIONS[type(config)]
    path = directory / "config.json"
    if path.exists():
        settings = read_json(path)
    else:
        settings = {}
    if settings.keys() - {name for name, _ in SECTIONS.values()}:
        raise ConvertError(f"{directory}: is a run directory; choose another one")
    with disk_guard(directory):
        (directory / place).parent.mkdir(parents=True, exist_ok=True)
        # Settings are removed first: if stopped in between, none are left beside another network's weights.
        old = [settings.pop(name, None) for name, there in SECTIONS.values() if there == place]
        if replaces := any(old):
            write_json(path, settings)
        save_weights(directory / place, params)
        write_json(path, settings | {section: to_dict(config)})
    return replaces


def save_part(directory: Path, part: Part, model: ModelConfig, inputs: Inputs, params: Params) -> bool:
    """Writes the autoencoder or the world model of a family that has both; the directory's other part is kept.

    Args:
        model: the family's settings, including those of the other part in the directory (:func:`saved_part`).
        inputs: image size and action dimension that the networks take.

    Returns:
        Whether the directory had such a part, which it replaced.

    Raises:
        ConvertError: the directory is a run's, or holds networks of another kind.
        FileError: the disk is full.
    """
    path = directory / "config.json"
    if path.exists():
        settings = read_json(path)
    else:
        settings = {}
    if settings.keys() - {"model", "inputs"}:
        raise ConvertError(f"{directory}: is a run directory or holds other networks; choose another one")
    with disk_guard(directory):
        place = directory / part / "weights"
        place.parent.mkdir(parents=True, exist_ok=True)
        if replaces := place.exists():
            path.unlink(missing_ok=True)  # if stopped in between, no settings are left beside another network's weights
        save_weights(place, params)
        write_json(path, {"model": to_dict(model), "inputs": inputs._asdict()})
    return replaces


def saved_part(directory: Path, kind: type[M], part: Part) -> tuple[M, Inputs] | None:
    """Returns settings and inputs of a part that :func:`save_part` wrote or a run trained; None if there is no part.

    Raises:
        UserError: the settings are damaged, or of another family.
    """
    if not has_weights(directory, part) or not (directory / "config.json").exists():
        return None
    return read_model(directory, kind, part), saved_inputs(directory)


def load_tokenizer(directory: Path) -> tuple[TokenizerConfig, Params]:
    """Reads the tokenizer of a converted directory or a run directory.

    Raises:
        UserError: there is none, or it is damaged.
    """
    config = read_tokenizer_config(directory)
    shapes = jax.eval_shape(Tokenizer(config).init_params, jax.random.key(0))
    return config, load_part(directory, "tokenizer", shapes)


def load_world_model(directory: Path) -> tuple[Architecture, Params]:
    """Reads the world model of a converted directory, or of a run of RoboScape or Genie.

    Raises:
        UserError: there is none, or it is damaged.
    """
    architecture = read_architecture(directory)
    shapes = jax.eval_shape(Transformer(architecture).init_params, jax.random.key(0))
    return architecture, load_part(directory, "world_model", shapes)


def load_kl_autoencoder(directory: Path) -> tuple[KLConfig, Params]:
    """Reads the autoencoder of a converted directory, or of a run of IRASim. Errors as in :func:`load_world_model`."""
    config = pretrained.saved_autoencoder(directory)
    shapes = jax.eval_shape(lambda key: autoencoder.init(config, key), jax.random.key(0))
    return config, load_part(directory, "tokenizer", shapes)


def load_irasim(directory: Path) -> tuple[dit.Architecture, Params]:
    """Reads the transformer of a converted directory, or of a run of IRASim. Errors as in :func:`load_world_model`."""
    architecture = pretrained.saved_network(directory)
    shapes = jax.eval_shape(dit.DiT(architecture).init_params, jax.random.key(0))
    return architecture, load_part(directory, "world_model", shapes)
