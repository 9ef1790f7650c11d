"""The weights that a fine-tuning starts from: those of a trained model, without its action encoder.

The new robot's actions have another width and another meaning. So the encoder begins anew, and its output at zero: at
first the model predicts what follows without any action.
"""

from dataclasses import dataclass, fields, replace
from pathlib import Path

from flax.traverse_util import flatten_dict, unflatten_dict

from rsjax.config import Config, GenieConfig, TokenModelConfig, TransformerConfig, content_key, presets
from rsjax.errors import UserError
from rsjax.evaluation.results import fingerprint
from rsjax.files import checked_path
from rsjax.model_directory import SETTINGS, Part, has_weights, locate, read_settings
from rsjax.models.load_run import load_config
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.pretrained import read_architecture
from rsjax.tokenizers.training import read_tokenizer_config
from rsjax.tools.convert import directory as converted
from rsjax.trainable import Params

ACTIONS = ("action_encoder", "null_action", "action_norms")  # parts of the names of parameters that read actions
GENIE = "genie_35m_actions"  # the preset with the settings that a converted checkpoint does not have


@dataclass(frozen=True)
class StartingModel:
    """A trained model to start from.

    Attributes:
        config: its configuration; of a converted checkpoint, the public Genie's with the checkpoint's networks.
        architecture: of its world model.
    """

    directory: Path
    config: Config
    architecture: Architecture

    @property
    def image_size(self) -> int:
        """Pixels a side of the frames that it takes."""
        return self.architecture.grid * self.config.tokenizer.downsampling


def find_source(name: Path | str) -> StartingModel:
    """Finds a model by its name in the package, or in a run directory, a saved model or a converted checkpoint.

    Raises:
        UserError: there is none, a network is missing, or it is of a family without tokens.
    """
    directory = locate(checked_path(name, "model"))
    if not (directory / SETTINGS).exists():
        raise UserError(
            f"{directory}: no model there (no {SETTINGS}); name tiny, a run directory, a saved model, or a directory "
            f"that rsjax convert made"
        )
    parts: tuple[Part, ...] = ("tokenizer", "world_model")
    for part in parts:
        if not has_weights(directory, part):
            raise UserError(
                f"{directory}: holds no {part}/weights; a run has to be finished, and a converted checkpoint needs "
                f"rsjax convert tokenizer and rsjax convert genie into one directory"
            )
    if "name" not in read_settings(directory, "make it again"):  # a converted checkpoint
        architecture = read_architecture(directory)
        preset = presets.get(GENIE)
        assert isinstance(preset.model, GenieConfig)
        networks = {field.name: getattr(architecture, field.name) for field in fields(TransformerConfig)}
        networks["action_encoder"] = preset.model.action_encoder
        tokenizer = replace(read_tokenizer_config(directory), vocabularies=architecture.vocabularies)
        config = replace(preset, tokenizer=tokenizer, model=replace(preset.model, **networks))
        return StartingModel(
            directory, replace(config, eval=replace(config.eval, clips=100, repetitions=1)), architecture
        )
    config = load_config(directory)
    if not isinstance(config.model, TokenModelConfig):
        raise UserError(
            f"{directory}: a model of family {config.model.family!r}; rsjax finetune takes roboscape and genie, and "
            f"rsjax train --train.start-from the others"
        )
    if config.second_view:
        raise UserError(f"{directory}: its model reads a second view (sim.second_view), which recordings do not have")
    return StartingModel(directory, config, read_architecture(directory))


def content_of(source: StartingModel) -> str:
    """Returns a hash of a model's settings and weights, which stays the same where the model is moved to."""
    _, tokenizer_params = converted.load_tokenizer(source.directory)
    _, params = converted.load_world_model(source.directory)
    return content_key(source.config, fingerprint((tokenizer_params, params)))


def write_start(source: StartingModel, folder: Path) -> None:
    """Writes both networks, the world model's without its action encoder, as ``rsjax convert`` does."""
    tokenizer, tokenizer_params = converted.load_tokenizer(source.directory)
    _, params = converted.load_world_model(source.directory)
    without = replace(
        source.architecture,
        action_encoder="none",
        action_inputs=0,
        departures=replace(source.architecture.departures, integrate_actions=False, action_dropout=0.0),
    )
    converted.save(folder, tokenizer, tokenizer_params)
    converted.save(folder, without, without_actions(params))


def without_actions(params: Params) -> Params:
    """Returns a world model's parameters except those that read actions."""
    flat = flatten_dict(params, sep="/")
    kept = {path: x for path, x in flat.items() if not any(word in path for word in ACTIONS)}
    return unflatten_dict(kept, sep="/")
