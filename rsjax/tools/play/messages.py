"""Reads the fields of a page's messages; refuses wrong ones with a message of one line."""

import json
from collections.abc import Sequence
from typing import Any


class Refused(Exception):
    """A message of a page cannot be done; the session continues.

    Attributes:
        code: a short word for the page, one of those in docs/play_protocol.md.
        message: one plain line for the person.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code
        self.message = message


TEXT_BYTES = 256 * 2**10
UPLOAD_BYTES = 8 * 2**20
MOST_ID = 2**32 - 1


def parse(text: str) -> dict[str, Any]:
    """Parses a message.

    Raises:
        Refused: the text is too large, or is not a JSON object with a type and an id.
    """
    if len(text) > TEXT_BYTES:
        raise Refused("too_large", f"a message can have {TEXT_BYTES} characters")
    try:
        message = parse_json(text)
    except ValueError as error:
        raise Refused("bad_message", "a message is JSON") from error
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise Refused("bad_message", "a message is a JSON object with a type")
    return message


def parse_json(text: str | bytes) -> Any:
    """Parses JSON without NaN and Infinity; fields of numbers have bounds of their own.

    Raises:
        ValueError: it is not JSON, or is nested too deeply.
    """

    def refuse(constant: str) -> float:
        raise ValueError(constant)

    try:
        return json.loads(text, parse_constant=refuse)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def whole(message: dict[str, Any], name: str, low: int, high: int, default: int | None = None) -> int:
    """Returns a field that is a whole number from ``low`` to ``high``."""
    value = message.get(name, default)
    if type(value) is not int or not low <= value <= high:
        raise Refused("bad_message", f"{name} is {_short(value)}; it is a whole number from {low} to {high}")
    return value


def number(message: dict[str, Any], name: str, low: float, high: float, default: float | None = None) -> float:
    """Returns a field that is a number from ``low`` to ``high``."""
    value: Any = message.get(name, default)
    right = isinstance(value, int | float) and not isinstance(value, bool)
    if not right or not low <= value <= high:  # nor are NaN and integers that no float can hold
        raise Refused("bad_message", f"{name} is {_short(value)}; it is a number from {low:g} to {high:g}")
    return float(value)


def choice(message: dict[str, Any], name: str, choices: Sequence[str], default: str | None = None) -> str:
    """Returns a field that is one of ``choices``."""
    value = message.get(name, default)
    if value not in choices or not isinstance(value, str):
        raise Refused("bad_message", f"{name} is {_short(value)}; it is one of {', '.join(choices)}")
    return value


def words(message: dict[str, Any], name: str, most: int) -> list[str]:
    """Returns a field that is a list of at most ``most`` words."""
    value = message.get(name)
    if not isinstance(value, list) or len(value) > most or not all(isinstance(word, str) for word in value):
        raise Refused("bad_message", f"{name} is {_short(value)}; it is a list of words")
    return value


def kinds(message: dict[str, Any], known: Sequence[str]) -> list[str]:
    """Returns the field "kinds", a list of words from ``known``."""
    chosen = words(message, "kinds", 16)
    for kind in chosen:
        if kind not in known:
            raise Refused("bad_message", f"kinds has {_short(kind)}; there are {', '.join(known)}")
    return list(dict.fromkeys(chosen))


def _short(value: object) -> str:
    if value is None:
        return "missing"
    return f"{value!r:.40}"
