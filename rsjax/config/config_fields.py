"""The fields of a nested config by dotted name: reads them all, or replaces several at once.

A section that may be of several classes, or off, is a field too, whose value is the word that chooses it
(:func:`rsjax.config.fields.section_choices`): ``train.optimizer`` is "muon" or "adamw".
"""

import dataclasses
import typing
from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple, TypeVar

from rsjax.config.fields import section_choices

T = TypeVar("T")


class ConfigField(NamedTuple):
    """A field of a config.

    Attributes:
        kind: its declared type; of a section, a ``Literal`` of the words that choose it.
        runtime: whether it is a runtime field (:func:`rsjax.config.fields.runtime`).
        section: whether it is the choice of a section.
    """

    value: Any
    kind: Any
    runtime: bool = False
    section: bool = False


def config_fields(config: Any, prefix: str = "") -> dict[str, ConfigField]:
    """Returns every field of a config dataclass and of those nested in it, by dotted name (``loss.gamma``)."""
    hints = typing.get_type_hints(type(config))
    out: dict[str, ConfigField] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        name = prefix + field.name
        choices = section_choices(hints[field.name])
        if choices:
            word = next(word for word, kind in choices.items() if isinstance(value, kind or type(None)))
            out[name] = ConfigField(word, Literal[*choices], section=True)
        if dataclasses.is_dataclass(value):
            out |= config_fields(value, f"{name}.")
        elif not choices:
            out[name] = ConfigField(value, hints[field.name], bool(field.metadata.get("runtime")))
    return out


def with_values(config: T, values: Mapping[str, Any]) -> T:
    """Returns the config with new values for these dotted names. It is checked once, after all are set.

    A section may be given itself or by its word. Values inside a section that is off switch it on.

    Raises:
        ConfigError: the combination is impossible.
    """
    if not values:
        return config
    hints = typing.get_type_hints(type(config))
    changes: dict[str, Any] = {}
    for head in {name.partition(".")[0] for name in values}:
        inner = {name.partition(".")[2]: value for name, value in values.items() if name.startswith(f"{head}.")}
        value = getattr(config, head)
        choices = section_choices(hints[head])
        if head in values:
            value = values[head]
            if value in choices:
                value = converted_section(getattr(config, head), choices[value])
        elif value is None:
            value = choices["on"]()
        changes[head] = with_values(value, inner)
    return dataclasses.replace(config, **changes)  # type: ignore[type-var]


def converted_section(section: Any, kind: Any) -> Any:
    """Returns the section as one of another class, with the values of the fields that both have and that it allows."""
    if kind is None:
        return None
    if section is None:
        return kind()
    hints = typing.get_type_hints(kind)
    shared = {field.name for field in dataclasses.fields(kind)} & vars(section).keys()
    values = {name: getattr(section, name) for name in shared}
    choices = {name: typing.get_args(hints[name]) for name in shared if typing.get_origin(hints[name]) is Literal}
    return kind(**{name: value for name, value in values.items() if value in choices.get(name, (value,))})


def with_sections(config: T, names: Iterable[str]) -> T:
    """Returns the config with those sections on that were off and contain one of these dotted names."""
    heads = {name.rpartition(".")[0] for name in names}
    off = {name for name, field in config_fields(config).items() if field.value == "off" and name in heads}
    return with_values(config, dict.fromkeys(off, "on"))
