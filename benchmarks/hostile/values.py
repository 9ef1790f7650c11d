"""Absurd values by the type of an option, and which of them no option of that type may take."""

import types
import typing
from pathlib import Path
from typing import Any, Literal, NamedTuple

LONG = "9" * 400
OUTPUTS = ("out", "run_dir", "dir", "json", "dump", "fix", "sheet", "rerun_file", "into", "blind")


class Absurd(NamedTuple):
    """One value as a word of a command line; ``impossible``: no option of this type may take it."""

    word: str
    impossible: bool = True


NUMBERS = tuple(map(Absurd, ("nan", "", "x", "²", "1e3000", LONG)))
WHOLE = (
    *NUMBERS,
    *map(Absurd, ("1.5", str(2**63))),
    Absurd("-1", False),
    Absurd("0", False),
    Absurd("99999999999", False),
    Absurd("99999999", False),  # below the limit of every number
)
REAL = (*NUMBERS, *map(Absurd, ("inf", "-inf")), Absurd("-1", False), Absurd("0", False), Absurd("1e30", False))
TEXTS = tuple(Absurd(word, False) for word in ("", "x" * 100_000, "\x1b[31m\n", "\udcff", "../../etc", "²"))
INPUTS = tuple(
    map(
        Absurd,
        ("", "MATERIAL/nowhere", "MATERIAL/file", "MATERIAL/empty", "MATERIAL/fifo", "n" * 5000, "\udcff", "/dev/zero"),
    )
)
PLACES = (
    *map(Absurd, ("", "MATERIAL/file/below", "/proc/nowhere", "n" * 300, "n" * 5000)),
    Absurd("MATERIAL/file", True),
    Absurd("MATERIAL/fifo", True),
)


def absurd_values(name: str, hint: Any) -> tuple[Absurd, ...]:
    """Returns absurd values for an option of this declared type."""
    for origin in (typing.Union, types.UnionType):
        if typing.get_origin(hint) is origin:
            hint = next(kind for kind in typing.get_args(hint) if kind is not type(None))
    if typing.get_origin(hint) is typing.Annotated:
        return absurd_values(name, typing.get_args(hint)[0])
    if typing.get_origin(hint) is tuple:
        return absurd_values(name, typing.get_args(hint)[0])
    if typing.get_origin(hint) is Literal:
        return (Absurd(""), Absurd("x"), Absurd("\udcff"), Absurd("x" * 100_000))
    if hint is int:
        return WHOLE
    if hint is float:
        return REAL
    if hint is Path:
        return PLACES if name in OUTPUTS else INPUTS
    if hint is str:
        return TEXTS
    return ()
