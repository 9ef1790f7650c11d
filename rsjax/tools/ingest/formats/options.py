"""Checks values that users write (``--option``, ``dataset.json``, key maps) against the types declared in the code."""

import dataclasses
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from rsjax.errors import did_you_mean
from rsjax.tools.ingest.episode import SourceError

T = TypeVar("T")

_WORDS = {  # words for one value and for several
    bool: ("true or false", "true or false"),
    int: ("a whole number", "whole numbers"),
    float: ("a number", "numbers"),
    str: ("text", "texts"),
}


def check_options(values: Mapping[str, Any], known: Mapping[str, Any], where: str, word: str) -> None:
    """Checks names and types of values.

    Args:
        values: as a user wrote them.
        known: the type of each name.
        where: the start of error messages, such as a file or ``lerobot: option``.
        word: what the values are, such as ``option`` or ``field``.

    Raises:
        SourceError: there is no such name, or its value has another type.
    """
    for name, value in values.items():
        if name not in known:
            hint = did_you_mean(name, known)
            raise SourceError(f"{where}: no {word} {name!r}{hint}; it has {', '.join(known) or 'none'}")
        if not _fits(value, known[name]):
            if word == "option":
                subject = f"option {name}"
            else:
                subject = name
            raise SourceError(f"{where}: {subject} is {value!r}, should be {_describe(known[name])}")


def from_json(kind: type[T], values: Any, where: Path | str) -> T:
    """Builds a dataclass from a JSON object; lists become tuples.

    Raises:
        SourceError: ``values`` is not an object, or a field is unknown, missing or of another type.
    """
    hints = get_type_hints(kind)
    if not isinstance(values, Mapping):
        raise SourceError(f"{where}: should be an object with {', '.join(hints)}")
    check_options(values, hints, str(where), "field")
    missing = dataclasses.MISSING
    fields = dataclasses.fields(kind)  # type: ignore
    required = [field.name for field in fields if field.default is missing and field.default_factory is missing]
    for name in required:
        if not values.get(name):
            raise SourceError(f"{where}: {name} is missing or empty; give {', '.join(required)}")
    return kind(**{name: tuple(value) if isinstance(value, list) else value for name, value in values.items()})


def _fits(value: Any, hint: Any) -> bool:
    """Returns whether a value that was parsed from JSON is of a type."""
    origin = get_origin(hint)
    inner = get_args(hint)
    if origin in (types.UnionType, Union):
        return any(_fits(value, one) for one in inner)
    if origin is Literal:
        return isinstance(value, str) and value in inner
    if origin in (Sequence, tuple):
        return isinstance(value, list | tuple) and all(_fits(item, inner[0]) for item in value)
    if origin is Mapping:
        return isinstance(value, dict) and all(_fits(item, inner[1]) for item in value.values())
    if isinstance(value, bool):
        return hint is bool
    return isinstance(value, int | float if hint is float else hint)


def _describe(hint: Any, many: bool = False) -> str:
    """Returns a description of a type's values in words."""
    origin = get_origin(hint)
    inner = [one for one in get_args(hint) if one not in (types.NoneType, ...)]
    if origin in (types.UnionType, Union):
        return " or ".join(_describe(one, many) for one in inner)
    if origin is Literal:
        return " or ".join(inner)
    if origin in (Sequence, tuple):
        return f"a list of {_describe(inner[0], many=True)}"
    if origin is Mapping:
        return f"an object of {_describe(inner[1], many=True)}"
    return _WORDS[hint][many]
