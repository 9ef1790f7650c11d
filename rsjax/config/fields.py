"""What all configs share: the error, runtime fields, dictionaries and content keys."""

import dataclasses
import hashlib
import json
import typing
from dataclasses import field
from typing import Any, TypeVar

from rsjax.errors import UserError

T = TypeVar("T")


class ConfigError(UserError):
    """A configuration that cannot run. The message names the field and the cure."""


def runtime(default: Any) -> Any:
    """A dataclass field that does not change results and is left out of content keys."""
    return field(default=default, metadata={"runtime": True})


def require(condition: bool, message: str) -> None:
    """Raises :class:`ConfigError` with ``message`` unless ``condition`` holds."""
    if not condition:
        raise ConfigError(message)


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain JSON-ready values."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_dict(kind: type[T], values: dict[str, Any]) -> T:
    """The inverse of :func:`to_dict`. Fields that are missing take their defaults.

    Raises:
        ConfigError: ``values`` or a part of it holds no fields by name; a field is unknown, as in a file written by
            another version; or the values cannot run.
        TypeError: a field without a default is missing.
    """
    require(isinstance(values, dict), f"{kind.__name__} is to be fields by name; it is {values!r:.40}")
    hints = typing.get_type_hints(kind)
    unknown = set(values) - set(hints)
    require(not unknown, f"{kind.__name__} has no field {', '.join(sorted(unknown))}; the file is of another version")
    return kind(**{name: _read(f"{kind.__name__}.{name}", hints[name], value) for name, value in values.items()})


def _read(name: str, hint: Any, value: Any) -> Any:
    """A field's value out of JSON's: dataclasses out of objects and tuples out of lists, also within one another."""
    if dataclasses.is_dataclass(hint):
        return from_dict(typing.cast(type, hint), value)
    if typing.get_origin(hint) is tuple:
        require(isinstance(value, list), f"{name} is to be a list; it is {value!r:.40}")
        return tuple(_read(name, typing.get_args(hint)[0], item) for item in value)
    return value


def content_key(*parts: Any) -> str:
    """16 hex digits that change exactly when the results of ``parts`` would.

    Args:
        parts: config dataclasses (runtime fields are left out), strings or numbers.
    """
    return hashlib.sha256(json.dumps([_content(p) for p in parts], sort_keys=True).encode()).hexdigest()[:16]


def _content(part: Any) -> Any:
    if isinstance(part, tuple):
        return [_content(item) for item in part]
    if not dataclasses.is_dataclass(part):
        return part
    kept = [f.name for f in dataclasses.fields(part) if not f.metadata.get("runtime")]
    return {"": type(part).__name__} | {name: _content(getattr(part, name)) for name in kept}
