"""One hostile input, how it can end, and what counts as a good end."""

import io
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

Kind = Literal["refused", "ended", "began", "broke", "unclear"]
GOOD = ("clear line", "harmless", "documented")
BAD = ("traceback", "unclear line", "accepted", "hang", "died")
LONGEST_LINE = 1000  # characters of a clear line


class Began(BaseException):
    """The command passed all its checks and starts to work, which a case does not wait for."""


class Ended(NamedTuple):
    """The end of a case.

    Attributes:
        kind: refused with a message; ended without one; began to work; broke with a traceback; or unclear.
        text: the message, the traceback, or what was printed.
    """

    kind: Kind
    text: str = ""


@dataclass(frozen=True)
class Place:
    """Directories of a case.

    Attributes:
        material: a copy of the material, which the case may damage; it is whole when the case begins.
        scratch: an empty directory for what the case writes.
    """

    material: Path
    scratch: Path


@dataclass(frozen=True)
class Case:
    """One hostile input.

    Attributes:
        name: unique, with its group first: "options: serve --port -1".
        act: gives the input and returns how it ended.
        names: a refusal has to contain one of these words; empty: any.
        accepted: why the input may be accepted; empty: it has to be refused or to change nothing.
    """

    name: str
    act: Callable[[Place], Ended]
    names: tuple[str, ...] = ()
    accepted: str = ""


def verdict(case: Case, ended: Ended) -> str:
    """Returns one of GOOD or BAD."""
    if ended.kind == "broke":
        return "traceback"
    if ended.kind == "unclear":
        return "unclear line"
    if ended.kind == "refused":
        named = not case.names or any(word.lower() in ended.text.lower() for word in case.names)
        short = len(ended.text) <= LONGEST_LINE and "\n" not in ended.text.strip()
        return "clear line" if named and short else "unclear line"
    if case.accepted:
        return "documented"
    return "harmless" if ended.kind == "ended" else "accepted"


def command(words: Sequence[str], place: Place) -> Ended:
    """Runs a command in this process, as its module does.

    Words in capitals stand for paths: NEW is one that does not exist, MATERIAL the directory of the material.
    """
    filled = [fill(word, place) for word in words]
    name = filled[0]
    out = io.StringIO()
    errors = io.StringIO()
    before = sys.argv
    sys.argv = [f"rsjax {name}", *filled[1:]]
    try:
        with redirect_stdout(out), redirect_stderr(errors):
            module_of(name).main()
        status = 0
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except Began as began:
        return Ended("began", str(began))
    except BaseException:
        return Ended("broke", traceback.format_exc())
    finally:
        sys.argv = before
    lines = [line for line in errors.getvalue().splitlines() if line.startswith("error: ")]
    said = errors.getvalue() + out.getvalue()
    if "Traceback (most recent call last)" in said:
        return Ended("broke", said)
    if status == 2 and len(lines) == 1:
        return Ended("refused", lines[0])
    if status in (0, 1) and not lines:  # with 1, doctor and inspect report damage in their own words
        return Ended("ended" if status == 0 else "refused", out.getvalue()[:LONGEST_LINE].replace("\n", " "))
    return Ended("unclear", f"exit status {status}: {said}")


def module_of(name: str) -> Any:
    """Returns the module of a command, or of a study that has no command."""
    return import_module("rsjax.tools.studies.softness" if name == "softness" else f"rsjax.tools.commands.{name}")


def fill(word: str, place: Place) -> str:
    """Returns a word of a command with the paths of a case."""
    word = re.sub(r"\bNEW\b", str(place.scratch / "new"), word)
    return re.sub(r"\bMATERIAL\b", str(place.material), word)


def call(act: Callable[[], object]) -> Ended:
    """Calls something of the API, or of an environment, and returns how it ended."""
    from gymnasium.error import Error

    from rsjax.errors import UserError

    try:
        act()
    except (UserError, Error, IndexError) as error:
        return Ended("refused", str(error))
    except Began as began:
        return Ended("began", str(began))
    except BaseException:
        return Ended("broke", traceback.format_exc())
    return Ended("began", "returned")
