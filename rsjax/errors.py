"""Errors that a user can cure, each one clear line. Commands print them without a traceback."""

import difflib
from collections.abc import Iterable


class UserError(Exception):
    """Something that the user can put right. The message is one line that names the thing and the cure.

    Not a :class:`ValueError`, so that libraries which catch those (the command-line parser does) pass it on untouched.

    Attributes:
        status: what a command that ends with it exits with.
    """

    status = 2


def did_you_mean(word: str, choices: Iterable[str], prefix: str = "") -> str:
    """``"; did you mean 'tiny'?"`` for the nearest of ``choices``, or nothing where none is near.

    A choice whose last dotted part is ``word`` counts as nearest: ``steps`` finds ``train.steps``.

    Args:
        word: what was written.
        choices: what there is.
        prefix: put before each suggestion, such as the dashes of a flag.
    """
    choices = list(choices)
    near = [c for c in choices if c.rpartition(".")[2] == word] or difflib.get_close_matches(word, choices, n=1)
    return f"; did you mean {' or '.join(repr(prefix + c) for c in near)}?" if near else ""


def first_line(error: object) -> str:
    """Returns the first line of an error's message, at most 200 characters, or its type's name where it has none."""
    return str(error).strip().partition("\n")[0][:200] or type(error).__name__


class Preempted(BaseException):
    """The process was told to stop (SIGTERM) and did, with its work saved. The message says what goes on with it.

    Not an :class:`Exception`, as :class:`KeyboardInterrupt` is none: it may be raised anywhere, and what handles errors
    there must not take it for one.
    """
