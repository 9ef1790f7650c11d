"""Reports the errors of a command as one line and an exit status."""

import contextlib
import errno
import io
import os
import re
import select
import signal
import sys
from collections.abc import Collection, Iterator, Sequence

from rsjax.errors import Preempted, UserError, storage_limit
from rsjax.runtime import INTERRUPTED, TERMINATED, exit_now, stop_signals

LONGEST_WORD = 400  # characters of a word in a message, such as a path; longer ones are cut off
LONGEST_LINE = 1000  # characters of a message; the middle of a longer one is left out
UNREAD = 128 + signal.SIGPIPE  # the exit status of a process that SIGPIPE ends


def refuse_repeated(argv: Sequence[str], repeatable: Collection[str] = ()) -> None:
    """Refuses an option that is given twice; parsers would silently take the last one.

    Args:
        argv: the arguments of a command. ``--no-x`` and ``--x`` are one option.
        repeatable: names of options that add up, without dashes in front.

    Raises:
        UserError: an option is repeated.
    """
    names: set[str] = set()
    for word in argv:
        if not re.match(r"--\w", word):
            continue
        name = re.sub(r"(^|\.)no-", r"\1", word[2:].partition("=")[0].replace("_", "-"))
        if name in names and name not in repeatable:
            raise UserError(f"--{name} is given twice; give it once, with all its values")
        names.add(name)


@contextlib.contextmanager
def main_errors() -> Iterator[None]:
    """Turns errors that the user can cure into one line on standard error and an exit status, without a traceback.

    Wraps a command's main function, as a decorator or in a ``with`` statement. Exits with 2 for most
    :class:`UserError`, a full disk or a missing permission, with 130 for an interrupt, with 75 (start the command
    again) for SIGTERM, and with 141 and no message if nobody reads the output any more (``| head``). Any other
    exception is a bug and keeps its traceback.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names need not be valid text
    os.environ["MPLBACKEND"] = "agg"  # figures only go to files; importing matplotlib fails on unknown backends
    with stop_signals() as received:
        try:
            yield
            if sys.stdout is not None:  # None if the shell closed it with >&-
                sys.stdout.flush()
        except (Exception, KeyboardInterrupt) as error:
            if isinstance(error, BrokenPipeError) and _unread():
                exit_now(UNREAD)
            line, status = _answer(error, received)
            if line is None:
                raise
            print(_readable(line), file=sys.stderr)
            # At exit, the processes of a distributed run wait for each other. A process that failed would wait in
            # vain, and jax would then abort with its own status.
            orderly = (os.EX_TEMPFAIL,) if _has_peers() else (UserError.status,)
            if status not in orderly:
                exit_now(status)
            raise SystemExit(status) from error


def _unread() -> bool:
    """Says whether standard output is a pipe whose other end was closed."""
    try:
        output = sys.stdout.fileno()
    except (AttributeError, OSError, ValueError):  # closed, or not a file
        return False
    state = select.poll()
    state.register(output, 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in state.poll(0))


def _answer(error: BaseException, received: list[int]) -> tuple[str | None, int]:
    """Returns the line that reports an error, None for a bug, and the exit status."""
    # A signal may surface as another error, such as an ImportError if it arrived during an import.
    if isinstance(error, Preempted):
        return str(error), os.EX_TEMPFAIL
    if isinstance(error, KeyboardInterrupt) or signal.SIGINT in received:
        return INTERRUPTED, 130
    if signal.SIGTERM in received:
        return TERMINATED, os.EX_TEMPFAIL
    if bad := _bad_variable(error):  # also if it surfaced as another error, such as one from a checkpoint
        return f"error: {bad}", 2
    if isinstance(error, UserError):
        return f"error: {error}", error.status
    where = f" at {error.filename}" if isinstance(error, OSError) and error.filename else ""
    if limit := storage_limit(error):
        cause, _, cure = limit.partition("; ")
        return f"error: {cause}{where}; {cure}: the same command resumes", 2
    if isinstance(error, PermissionError) or getattr(error, "errno", None) == errno.EROFS:
        return f"error: no permission to write or read{where}; choose another directory or change its owner", 2
    if where:  # a directory where a file should be, or the reverse, or a path where nothing can be created
        return f"error: {error.strerror}{where}; choose another path", 2  # type: ignore[attr-defined]
    return None, 2


def _bad_variable(error: BaseException | None) -> str:
    """Says which of jax's environment variables is invalid if that caused the error; "" otherwise."""
    platforms = os.environ.get("JAX_PLATFORMS")
    jax = sys.modules.get("jax")
    while error is not None:
        if (refused := _JAX_REFUSES.search(str(error))) and (value := os.environ.get(name := refused[1].upper())):
            return f"{name} is {value!r:.80}, which jax does not know; unset it"
        # For a kind of device that it knows but does not find, jax raises an empty AssertionError.
        unknown = isinstance(error, AssertionError) or "Unable to initialize backend" in str(error)
        if platforms and jax is not None and unknown:
            try:
                jax.devices()
            except Exception:
                return (
                    f"JAX has no device for JAX_PLATFORMS={platforms}; unset it to use what there is, or set it to cpu"
                )
        error = error.__cause__ or error.__context__
    return ""


_JAX_REFUSES = re.compile(
    r"^(?:invalid truth value .* for environment '|Invalid value .* for JAX flag )(jax_\w+)", re.I
)


def _readable(line: str) -> str:
    """Returns a message as one line of what can be seen: control characters escaped, and long words cut off."""
    words = [word if len(word) <= LONGEST_WORD else f"{word[:80]}… ({len(word)} characters)" for word in line.split()]
    text = " ".join(words)
    if len(text) > LONGEST_LINE:
        text = f"{text[: LONGEST_LINE - 300]} … {text[-250:]}"
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def is_lead() -> bool:
    """Says whether this is the only process of a command, or the first one of several."""
    return not _has_peers() or sys.modules["jax"].process_index() == 0


def _has_peers() -> bool:
    jax = sys.modules.get("jax")
    # A signal may have interrupted jax's import.
    return jax is not None and hasattr(jax, "distributed") and jax.distributed.is_initialized()
