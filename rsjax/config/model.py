"""Settings of the families of world models: one frozen dataclass each, with the common base :class:`ModelConfig`.

Each family is registered under a name. ``Config.model`` is one of them, chosen by the preset or by ``--model NAME``.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from importlib import import_module
from typing import Any, ClassVar, TypeVar, get_args, get_type_hints

from rsjax.config.data import ClipShape
from rsjax.config.fields import ConfigError, loss_weights, require
from rsjax.errors import did_you_mean

M = TypeVar("M", bound="type[ModelConfig]")


@dataclass(frozen=True)
class ModelConfig:
    """Base of every family's settings.

    Attributes:
        family: its registered name.
        uses_tokenizer: whether a tokenizer is trained before the model: that of ``Config.tokenizer``, or the family's
            own (:attr:`own_autoencoder`).
    """

    family: ClassVar[str] = ""
    uses_tokenizer: ClassVar[bool] = False

    def check(self, clips: ClipShape) -> None:
        """Raises :class:`rsjax.config.ConfigError` if the model does not fit clips of this shape."""

    def for_tasks(self, tasks: tuple[str, ...]) -> "ModelConfig":
        """Returns the settings for clips of these tasks, or of tasks without names if there are none."""
        return self

    @property
    def loss_weights(self) -> dict[str, float]:
        """The weight of each active loss term by name; by default the nonzero fields ``NAME_weight``."""
        return loss_weights(self)

    @property
    def own_autoencoder(self) -> Any:
        """Settings of the family's own autoencoder, in place of ``Config.tokenizer``; None if it has none.

        They are a frozen dataclass; :mod:`rsjax.tokenizers.autoencoder` says how a family defines one.
        """
        return None

    @property
    def token_shifts(self) -> tuple[int, ...]:
        """How many moved copies of a training clip have tokens, and how far they are moved; empty: none."""
        return ()

    @property
    def uses_depth(self) -> bool:
        """Whether the model learns from depth."""
        return False

    @property
    def without_depth(self) -> str:
        """The flag that leaves depth out, for messages."""
        return "--model.depth none"

    @property
    def takes_actions(self) -> bool:
        """Whether generated videos depend on actions; if they do not, ΔPSNR has no meaning."""
        return True

    @property
    def scanned(self) -> int:
        """How many equal parts of the network are computed in turn, for which ``remat`` "blocks" saves memory; 0: none.

        It is the leading axis of their parameters.
        """
        return 0

    @property
    def marked_keypoints(self) -> int:
        """How many keypoints the model selects in each clip, for the report's pictures; 0: none."""
        return 0

    @classmethod
    def chosen(cls, values: dict[str, Any]) -> tuple[type["ModelConfig"], dict[str, Any]]:
        """Returns the class and the fields of a dictionary made by :func:`rsjax.config.to_dict`."""
        require(isinstance(values.get("family"), str), "model has no family; the file is of another version")
        return family(values["family"]), {name: value for name, value in values.items() if name != "family"}


FAMILIES: dict[str, type[ModelConfig]] = {}  # those whose settings have been imported; families() imports all
BASELINES = ("cogvideox", "irasim", "ivideogpt")  # their settings are in rsjax/models/NAME/config.py


def register_family(name: str) -> Callable[[M], M]:
    """Registers a subclass of :class:`ModelConfig` under a name for ``--model`` and ``config.json``.

    Raises:
        ConfigError: another class already has that name.
    """

    def register(kind: M) -> M:
        require(FAMILIES.get(name, kind) is kind, f"two families of models are named {name!r}; rename one of them")
        kind.family = name
        FAMILIES[name] = kind
        return kind

    return register


def families() -> dict[str, type[ModelConfig]]:
    """Returns the settings class of every family by name."""
    for name in BASELINES:
        import_module(f"rsjax.models.{name}.config")
    return FAMILIES


def family(name: str) -> type[ModelConfig]:
    """Returns the settings class of the family called ``name``.

    Raises:
        ConfigError: the name is unknown; the message suggests the closest and lists all.
    """
    known = families()
    if name not in known:
        raise ConfigError(f"unknown model {name!r}{did_you_mean(name, known)} (models: {', '.join(sorted(known))})")
    return known[name]


def converted(model: ModelConfig, name: str) -> ModelConfig:
    """Returns settings of the family called ``name`` that keep those fields of ``model`` that are not defaults.

    Fields that the new family lacks or has of another type, such as its own ``sample``, are dropped.
    """
    kind = family(name)
    default = type(model)()
    values: dict[str, Any] = {f.name: getattr(model, f.name) for f in fields(model)}
    changed = {name: value for name, value in values.items() if value != getattr(default, name)}
    here = get_type_hints(type(model))
    there = get_type_hints(kind)
    choices = {name: get_args(there.get(name)) for name in changed}  # of a Literal
    shared = {name: x for name, x in changed.items() if here[name] == there.get(name) or x in choices[name]}
    return model if type(model) is kind else kind(**shared)
