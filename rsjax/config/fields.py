"""Helpers of all configs: their error, field markers, conversion to and from dictionaries, content keys."""

import dataclasses
import hashlib
import json
import math
import types
import typing
from collections.abc import Collection
from dataclasses import field
from typing import Any, TypeVar

from rsjax.errors import UserError

T = TypeVar("T")

MOST = 10**9  # of a command's numbers other than seeds: that many of anything take years
MOST_OF = {  # of a command's numbers with these names: more would take months, or all memory
    **dict.fromkeys(("demos", "episodes", "held_out", "imagined", "rollouts", "trials"), 10**6),
    **dict.fromkeys(("batch", "horizon", "horizons", "max_steps", "parts", "together"), 10**4),
    **dict.fromkeys(("checkpoints", "rounds", "trainings"), 10**3),
}
MOST_SEED = 2**32 - 1  # jax.random.key drops higher bits, so two seeds would give the same draws


class ConfigError(UserError):
    """An impossible configuration. The message names the field and the cure."""


def runtime(default: Any) -> Any:
    """Returns a dataclass field that does not change results; content keys leave it out."""
    return field(default=default, metadata={"runtime": True})


def sampling(default: Any) -> Any:
    """Returns a dataclass field that changes generated videos but not training; content keys leave it out.

    With an early stop, videos choose a training's weights; then its key has these fields, too.
    """
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


def require_range(config: Any, section: str, low: float, high: float, *names: str) -> None:
    """Raises :class:`ConfigError` unless each of these fields of a section lies in ``low`` … ``high``."""
    for name in names:
        value = getattr(config, name)
        wanted = f"at least {low}" if high == math.inf else f"{low} … {high}"
        require(low <= value <= high, f"{section}.{name} is {value}; it must be {wanted}")


def fitting_sizes(size: int, unit: int, least: int = 1, most: int | None = None) -> str:
    """Returns the multiples of ``unit`` next to ``size``, such as "240 or 256", for errors.

    Args:
        least, most: the least and the most units allowed.
    """
    near = {max(least, n if most is None else min(n, most)) for n in (size // unit, size // unit + 1)}
    return " or ".join(str(unit * n) for n in sorted(near))


def check_numbers(settings: Any, prefix: str = "", dash: bool = False) -> None:
    """Checks that every number of a dataclass is finite and every seed fits in 32 bits, also in nested dataclasses.

    Args:
        prefix: precedes the fields' names in the error.
        dash: whether they are options of a command, named as its flags. Then numbers below 0 are refused, too, unless
            the default is one, or the field's metadata has "signed".

    Raises:
        ConfigError: a number is not finite or too large, below 0, or a seed does not fit in 32 bits.
    """
    for f in dataclasses.fields(settings):
        name = prefix + (f.name.replace("_", "-") if dash else f.name)
        value = getattr(settings, f.name)
        signed = f.metadata.get("signed") or (isinstance(f.default, int | float) and f.default < 0)
        for item in value if isinstance(value, tuple) else (value,):
            if dash and isinstance(item, int | float) and not signed:
                require(not item < 0, f"{name} is {item}; it is 0 or more")
            if dataclasses.is_dataclass(item):
                check_numbers(item, f"{name}.", dash)
            elif isinstance(item, float):
                finite = math.isfinite(item) or item == f.default  # a limit that is off may be infinite
                require(finite, f"{name} is {item}; it must be a finite number")
                require(
                    not dash or not finite or abs(item) <= MOST or item == f.default,
                    f"{name} is {item}; {_at_most(MOST)}",
                )
            elif isinstance(item, int) and f.name in ("seed", "seeds"):
                require(0 <= item <= MOST_SEED, f"{name} is {item}; a seed is a whole number from 0 to {MOST_SEED}")
            elif isinstance(item, int):
                require(abs(item) < 2**63, f"{name} is {item}; it must fit in 64 bits")
                most = MOST_OF.get(f.name, MOST)
                require(not dash or abs(item) <= most, f"{name} is {item}; {_at_most(most)}")


def _at_most(most: int) -> str:
    return f"it can be at most {most:,}"


def section_choices(hint: Any) -> dict[str, Any]:
    """Returns what a section of this declared type may be, a class or None, by the word that chooses it.

    ``X | None`` is "on" or "off". Several classes are chosen by their class variable ``kind``, such as "muon". There
    are no words without a choice, or if a class has fields without a default.
    """
    options = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else ()
    kinds: list[Any] = [kind for kind in options if dataclasses.is_dataclass(kind)]
    if not kinds or any(f.default is dataclasses.MISSING for kind in kinds for f in dataclasses.fields(kind)):
        return {}
    words: dict[str, Any] = {"on": kinds[0]}
    if len(kinds) > 1:
        words = {kind.kind: kind for kind in kinds}
    if type(None) in options:
        words["off"] = None
    return words


def to_dict(config: Any) -> dict[str, Any]:
    """Returns a config as JSON-ready values, with the ``family`` or ``kind`` that tells a section's class."""
    values = {f.name: _plain(getattr(config, f.name)) for f in dataclasses.fields(config)}
    return {name: getattr(config, name) for name in ("family", "kind") if hasattr(config, name)} | values


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_dict(value)
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def from_dict(kind: type[T], values: dict[str, Any]) -> T:
    """Returns the config that :func:`to_dict` made these values from. Missing fields take their defaults.

    Raises:
        ConfigError: ``values`` or a nested value is not a dictionary; a field is unknown, as in a file written by
            another version, or its value of another type; or the configuration is impossible.
        TypeError: a field without a default is missing.
    """
    require(isinstance(values, dict), f"{kind.__name__} must be fields by name; it is {values!r:.40}")
    if hasattr(kind, "family"):
        kind, values = typing.cast(Any, kind).chosen(values)
    declared = typing.get_type_hints(kind)
    hints = {f.name: declared[f.name] for f in dataclasses.fields(typing.cast(Any, kind))}
    if "kind" not in hints and hasattr(kind, "kind"):
        values = {name: value for name, value in values.items() if name != "kind"}
    unknown = set(values) - set(hints)
    require(not unknown, f"{kind.__name__} has no field {', '.join(sorted(unknown))}; the file is of another version")
    return kind(**{name: _read(f"{kind.__name__}.{name}", hints[name], value) for name, value in values.items()})


def _read(name: str, hint: Any, value: Any) -> Any:
    """Converts a field's JSON value: objects to dataclasses and lists to tuples, recursively; checks its type."""
    if dataclasses.is_dataclass(hint):
        return from_dict(typing.cast(type, hint), value)

    def expect(right: bool, kind: str) -> None:
        require(right, f"{name} must be {kind}; it is {value!r:.40}")

    kinds = typing.get_args(hint)
    if typing.get_origin(hint) is tuple:
        expect(isinstance(value, list), "a list")
        return tuple(_read(name, kinds[0], item) for item in value)
    if typing.get_origin(hint) is typing.Literal:
        expect(value in kinds, f"one of {', '.join(map(str, kinds))}")
    elif typing.get_origin(hint) in (typing.Union, types.UnionType):
        if value is None and type(None) in kinds:
            return None
        choices = section_choices(hint)
        if choices and "on" not in choices:
            word = str(value.get("kind")) if isinstance(value, dict) else ""
            expect(word in choices, f"fields with a kind, {' or '.join(choices)}")
            return _read(name, choices[word], value)
        return _read(name, next(kind for kind in kinds if kind is not type(None)), value)
    elif hint in _JSON_KINDS:
        text, allowed = _JSON_KINDS[hint]
        expect(type(value) in allowed, text)
        if hint is float and isinstance(value, int):
            expect(abs(value) < 2**63, "a number that fits in 64 bits")
            return float(value)
    return value


_JSON_KINDS: dict[Any, tuple[str, tuple[type, ...]]] = {
    bool: ("true or false", (bool,)),
    int: ("a whole number", (int,)),
    float: ("a number", (float, int)),
    str: ("text", (str,)),
}


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
    deciding = [f.name for f in dataclasses.fields(part) if not f.metadata.keys() & {"runtime", "sampling"}]
    return {"": type(part).__name__} | {name: _content(getattr(part, name)) for name in deciding}
