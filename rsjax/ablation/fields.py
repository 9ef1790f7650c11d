"""The settings of a configuration by their dotted names, such as ``loss.gamma``."""

import dataclasses
import math
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from rsjax.errors import UserError, did_you_mean

T = TypeVar("T")
Value = bool | int | float | str


class GridError(UserError):
    """A grid that cannot be run as asked. The message names the field, the cell or the file, and the cure."""


@dataclass(frozen=True)
class Leaf:
    """One setting: its value, its declared type, and whether it only changes how a run is carried out."""

    value: Any
    kind: Any
    runtime: bool


def leaves(config: Any, prefix: str = "") -> dict[str, Leaf]:
    """Every setting of a config dataclass and of those nested in it, by dotted name."""
    hints = typing.get_type_hints(type(config))
    found: dict[str, Leaf] = {}
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), prefix + field.name
        if dataclasses.is_dataclass(value):
            found |= leaves(value, f"{name}.")
        else:
            found[name] = Leaf(value, hints[field.name], bool(field.metadata.get("runtime")))
    return found


def with_values(config: T, values: Mapping[str, Any]) -> T:
    """The config with other values at these dotted names, all set at once, so that only the outcome is checked.

    Raises:
        ConfigError: the combination cannot run.
    """
    nested: dict[str, dict[str, Any]] = {}
    fields: dict[str, Any] = {}
    for name, value in values.items():
        head, _, rest = name.partition(".")
        if rest:
            nested.setdefault(head, {})[rest] = value
        else:
            fields[head] = value
    fields |= {head: with_values(getattr(config, head), inner) for head, inner in nested.items()}
    return dataclasses.replace(config, **fields)  # type: ignore[type-var]


def parse_value(name: str, kind: Any, text: str) -> Value:
    """A field's value as it stands on the command line.

    Args:
        name: the field, for the error.
        kind: its declared type.

    Raises:
        GridError: the text is not of this type, or the field holds more than one value.
    """
    if kind is bool:
        return _choice(name, {"True": True, "False": False}, text)
    if typing.get_origin(kind) is Literal:
        return _choice(name, {str(choice): choice for choice in typing.get_args(kind)}, text)
    if kind is str:
        return text
    if kind not in (int, float):
        raise GridError(f"{name} holds more than one value, which a grid cannot vary; set it for all cells (--{name})")
    try:
        value = kind(text)
    except ValueError:
        raise GridError(f"{name} is {text!r} in the grid; it takes {_NUMBERS[kind]}") from None
    if not math.isfinite(value):
        raise GridError(f"{name} is {text!r} in the grid; it takes {_NUMBERS[kind]}")
    return value


_NUMBERS = {int: "a whole number", float: "a number"}


def _choice(name: str, choices: dict[str, Any], text: str) -> Any:
    if text not in choices:
        raise GridError(f"{name} is {text!r} in the grid{did_you_mean(text, choices)} (choices: {', '.join(choices)})")
    return choices[text]
