"""The fields of a nested config by dotted name: reads them all, or replaces several at once."""

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

T = TypeVar("T")


class ConfigField(NamedTuple):
    """A field's value, its declared type, and whether it is a runtime field (:func:`rsjax.config.fields.runtime`)."""

    value: Any
    kind: Any
    runtime: bool


def config_fields(config: Any, prefix: str = "") -> dict[str, ConfigField]:
    """Returns every field of a config dataclass and of those nested in it, by dotted name (``loss.gamma``)."""
    hints = typing.get_type_hints(type(config))
    out: dict[str, ConfigField] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        name = prefix + field.name
        if dataclasses.is_dataclass(value):
            out |= config_fields(value, f"{name}.")
        else:
            out[name] = ConfigField(value, hints[field.name], bool(field.metadata.get("runtime")))
    return out


def with_values(config: T, values: Mapping[str, Any]) -> T:
    """Returns the config with new values for these dotted names. It is checked once, after all are set.

    Raises:
        ConfigError: the combination is impossible.
    """
    changes: dict[str, Any] = {name: value for name, value in values.items() if "." not in name}
    for head in {name.partition(".")[0] for name in values if "." in name}:
        inner = {name.partition(".")[2]: value for name, value in values.items() if name.startswith(f"{head}.")}
        changes[head] = with_values(getattr(config, head), inner)
    return dataclasses.replace(config, **changes)  # type: ignore[type-var]
