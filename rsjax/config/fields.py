"""Helpers of all configs: their error, field markers, conversion to and from dictionaries, content keys."""

import dataclasses
import hashlib
import json
import typing
from collections.abc import Collection
from dataclasses import field
from typing import Any, TypeVar

from rsjax.errors import UserError

T = TypeVar("T")


class ConfigError(UserError):
    """An impossible configuration. The message names the field and the cure."""


def runtime(default: Any) -> Any:
    """Returns a dataclass field that does not change results; content keys leave it out."""
    return field(default=default, metadata={"runtime": True})


def sampling(default: Any) -> Any:
    """Returns a dataclass field that changes generated videos but not training; content keys leave it out."""
    return field(default=default, metadata={"sampling": True})


def sampling_settings(config: Any) -> tuple[Any, ...]:
    """Returns the values of a config's fields made with :func:`sampling`."""
    return tuple(getattr(config, f.name) for f in dataclasses.fields(config) if f.metadata.get("sampling"))


def loss_weights(settings: Any) -> dict[str, float]:
    """Returns the nonzero weights among a dataclass's fields by term: ``NAME_weight`` weighs the term NAME."""
    names = [f.name for f in dataclasses.fields(settings) if f.name.endswith("_weight")]
    return {name.removesuffix("_weight"): getattr(settings, name) for name in names if getattr(settings, name)}


def require(condition: bool, message: str) -> None:
    """Raises :class:`ConfigError` with ``message`` unless ``condition`` holds."""
    if not condition:
        raise ConfigError(message)


def to_dict(config: Any) -> dict[str, Any]:
    """Returns a config as JSON-ready values; a model's settings include the name of its ``family``."""
    values = {f.name: _plain(getattr(config, f.name)) for f in dataclasses.fields(config)}
    return ({"family": config.family} if hasattr(config, "family") else {}) | values


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_dict(value)
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def from_dict(kind: type[T], values: dict[str, Any]) -> T:
    """Returns the config that :func:`to_dict` made these values from. Missing fields take their defaults.

    Raises:
        ConfigError: ``values`` or a nested value is not a dictionary; a field is unknown, as in a file written by
            another version; or the configuration is impossible.
        TypeError: a field without a default is missing.
    """
    require(isinstance(values, dict), f"{kind.__name__} must be fields by name; it is {values!r:.40}")
    if hasattr(kind, "family"):
        kind, values = typing.cast(Any, kind).chosen(values)
    hints = {f.name: typing.get_type_hints(kind)[f.name] for f in dataclasses.fields(typing.cast(Any, kind))}
    unknown = set(values) - set(hints)
    require(not unknown, f"{kind.__name__} has no field {', '.join(sorted(unknown))}; the file is of another version")
    return kind(**{name: _read(f"{kind.__name__}.{name}", hints[name], value) for name, value in values.items()})


def _read(name: str, hint: Any, value: Any) -> Any:
    """Converts a field's JSON value: objects to dataclasses and lists to tuples, recursively."""
    if dataclasses.is_dataclass(hint):
        return from_dict(typing.cast(type, hint), value)
    if typing.get_origin(hint) is tuple:
        require(isinstance(value, list), f"{name} must be a list; it is {value!r:.40}")
        return tuple(_read(name, typing.get_args(hint)[0], item) for item in value)
    return value


def differences(saved: Any, own: Any, free: Collection[str]) -> str:
    """Returns the fields outside ``free`` in which two configs of one class differ, as text; empty if none."""
    names = [f.name for f in dataclasses.fields(own) if f.name not in free]
    values = [(name, getattr(saved, name), getattr(own, name)) for name in names]
    return "; ".join(f"{name} is {there} there, {here} here" for name, there, here in values if there != here)


def content_key(*parts: Any) -> str:
    """Returns 16 hex digits that change exactly when the results of ``parts`` would.

    Args:
        parts: config dataclasses (runtime and sampling fields are left out), strings or numbers.
    """
    return hashlib.sha256(json.dumps([_content(p) for p in parts], sort_keys=True).encode()).hexdigest()[:16]


def _content(part: Any) -> Any:
    if isinstance(part, tuple):
        return [_content(item) for item in part]
    if not dataclasses.is_dataclass(part):
        return part
    kept = [f.name for f in dataclasses.fields(part) if not f.metadata.keys() & {"runtime", "sampling"}]
    return {"": type(part).__name__} | {name: _content(getattr(part, name)) for name in kept}
