"""Errors that a user can fix. Commands print each as one line without a traceback."""

import difflib
import errno
import os
from collections.abc import Iterable


class UserError(Exception):
    """An error that the user can fix. The message is one line that names what is wrong and the cure.

    Parts of a file's name that are not text, surrogates, are shown as escapes, since no terminal could print them.

    Not a :class:`ValueError`, because some libraries, such as the command-line parser, catch those.

    Attributes:
        status: the exit status of a command that the error ends.
    """

    status = 2

    def __init__(self, message: object = "") -> None:
        line = " ".join(map(str.strip, str(message).splitlines()))  # an array that it shows may have lines
        super().__init__(line.encode(errors="backslashreplace").decode())


def did_you_mean(word: str, choices: Iterable[str], prefix: str = "") -> str:
    """Returns ``"; did you mean 'tiny'?"`` with the nearest of ``choices``, or "" if none is near.

    A choice whose last dotted part is ``word`` counts as nearest: ``steps`` matches ``train.steps``.

    Args:
        word: what the user wrote.
        choices: all valid words.
        prefix: precedes each suggestion, such as the dashes of a flag.
    """
    choices = list(choices)
    near = [c for c in choices if c.rpartition(".")[2] == word] or difflib.get_close_matches(word, choices, n=1)
    return f"; did you mean {' or '.join(repr(prefix + c) for c in near)}?" if near else ""


def first_line(error: object) -> str:
    """Returns the first line of an error's message, at most 200 characters, or its type's name where it has none."""
    return str(error).strip().partition("\n")[0][:200] or type(error).__name__


def storage_limit(error: object) -> str:
    """Says which limit of a disk an error reports, and the cure; "" for none.

    Libraries report these limits in their own errors, which contain the operating system's text somewhere.
    """
    number = getattr(error, "errno", None)
    text = str(error)
    for limit, cure in _LIMITS.items():
        if number == limit or os.strerror(limit) in text:
            return cure
    return ""


_LIMITS = {
    errno.ENOSPC: "the disk is full; free some space there and run again",
    errno.EDQUOT: "your quota of the disk is used up; free some space there and run again",
    errno.EFBIG: "the file is larger than this process may write; raise the limit (ulimit -f) and run again",
}


class Preempted(KeyboardInterrupt):
    """The process was stopped by SIGTERM, with its work saved. The message says how to resume.

    It is a :class:`KeyboardInterrupt` because it may be raised anywhere, and error handlers there must not catch it:
    asyncio, in which orbax saves and restores, logs and drops every other exception and would then wait forever.
    """
