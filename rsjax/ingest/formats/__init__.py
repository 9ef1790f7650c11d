"""The formats that people have, one module each, behind :class:`rsjax.ingest.episode.EpisodeSource`.

Each module has ``open_source(path, **options)``. A module, and the libraries it needs, is imported when its format is
asked for.
"""

import importlib
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from rsjax.errors import did_you_mean
from rsjax.ingest.episode import EpisodeSource, SourceError
from rsjax.ingest.formats.files import is_there

FORMATS = ("agibot", "lerobot", "robomimic", "libero", "rlds", "bair", "folder", "sim")

_WORDS = {  # one, several
    bool: ("true or false", "true or false"),
    int: ("a whole number", "whole numbers"),
    float: ("a number", "numbers"),
    str: ("text", "texts"),
}


def open_source(name: str, path: Path | str, **options: Any) -> EpisodeSource:
    """The data set of format ``name`` at ``path``; ``options`` are those of the format's own ``open_source``.

    Raises:
        SourceError: no such format, an option that it does not have, or nothing readable at ``path``.
    """
    if name not in FORMATS:
        raise SourceError(f"unknown format {name!r}{did_you_mean(name, FORMATS)}; there are {', '.join(FORMATS)}")
    opener = importlib.import_module(f"rsjax.ingest.formats.{name}").open_source
    known = {option: hint for option, hint in get_type_hints(opener).items() if option not in ("path", "return")}
    for option, value in options.items():
        if option not in known:
            raise SourceError(
                f"{name}: no option {option!r}{did_you_mean(option, known)}; it has {', '.join(known) or 'none'}"
            )
        if not _fits(value, known[option]):
            raise SourceError(f"{name}: option {option} is {value!r}, should be {_told(known[option])}")
    if not is_there(Path(path)):
        raise SourceError(f"{path}: not there; give the folder or file of the {name} data set")
    return opener(Path(path), **options)


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value from a command line is of an option's type."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (types.UnionType, Union):
        return any(_fits(value, one) for one in inner)
    if origin is Literal:
        return value in inner
    if origin is Sequence:
        return isinstance(value, list | tuple) and all(_fits(item, inner[0]) for item in value)
    if isinstance(value, bool):
        return hint is bool
    return isinstance(value, int | float if hint is float else hint)


def _told(hint: Any, many: bool = False) -> str:
    """What a value of an option's type is to be, in words."""
    inner = [one for one in get_args(hint) if one is not types.NoneType]
    if get_origin(hint) in (types.UnionType, Union):
        return " or ".join(_told(one, many) for one in inner)
    if get_origin(hint) is Literal:
        return " or ".join(inner)
    if get_origin(hint) is Sequence:
        return f"a list of {_told(inner[0], many=True)}"
    return _WORDS[hint][many]
