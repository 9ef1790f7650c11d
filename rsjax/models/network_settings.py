"""Reads the settings of a family's networks in a run directory, or in one made by ``rsjax convert``."""

from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from rsjax.config import Config, ConfigError, ModelConfig, from_dict
from rsjax.config.fields import differences
from rsjax.errors import UserError
from rsjax.model_directory import Part, has_weights, read_settings

M = TypeVar("M", bound=ModelConfig)


def read_model(directory: Path, kind: type[M], part: Part) -> M:
    """Returns the settings of a directory's model.

    Args:
        kind: the class of the family's settings.
        part: the network whose weights must be there, "tokenizer" or "world_model".

    Raises:
        UserError: the weights or their settings are missing, damaged, of another version or of another family.
    """
    path = directory / "config.json"
    settings = read_settings(directory, "make it with rsjax convert")
    check_family(path, settings, (kind.family,))
    if "model" not in settings or not has_weights(directory, part):
        raise UserError(f"{directory}: holds no {part}/weights of a model {kind.family!r} with settings in config.json")
    try:
        saved = from_dict(ModelConfig, settings["model"])
    except (ConfigError, TypeError) as error:
        raise UserError(f"{path}: the model's settings cannot be read ({error}); make it again") from error
    assert isinstance(saved, kind)
    return saved


def check_alike(directory: Path, saved: Any, own: Any, free: set[str], section: str) -> None:
    """Raises :class:`UserError` if two settings differ in fields outside ``free``; the message names them."""
    if differing := differences(saved, own, free):
        raise UserError(f"{directory}: holds another network ({differing}); set these fields of {section} alike")


def check_family(path: Path, settings: dict[str, Any], own: tuple[str, ...]) -> None:
    """Raises :class:`UserError` if the settings in a ``config.json`` are those of a family outside ``own``."""
    model = settings.get("model")
    name = model.get("family") if isinstance(model, dict) else None
    if name is not None and name not in own:
        raise UserError(f"{path}: holds a model of family {name!r}; start from one of family {' or '.join(own)}")


class Inputs(NamedTuple):
    """The sizes that networks were made for: pixels per side of an image, numbers in a frame's action (0: unknown)."""

    image_size: int
    action_dim: int


def saved_inputs(directory: Path) -> Inputs:
    """Returns the sizes that the networks of a directory were made for.

    Raises:
        UserError: the settings are missing, damaged or of another version.
    """
    path = directory / "config.json"
    settings = read_settings(directory, "make it with rsjax convert")
    try:
        if "inputs" in settings:  # written by rsjax convert
            return Inputs(**{name: int(value) for name, value in settings["inputs"].items()})
        clips = from_dict(Config, settings).clips
        return Inputs(clips.image_size, clips.action_dim)
    except (ConfigError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{path}: the model's settings cannot be read ({error}); make it again") from error
