"""Reports the errors of a command as one line and an exit status."""

import contextlib
import errno
import io
import os
import sys
from collections.abc import Iterator

from rsjax.errors import Preempted, UserError
from rsjax.runtime import sigterm_stops


@contextlib.contextmanager
def main_errors() -> Iterator[None]:
    """Turns errors that the user can cure into one line on standard error and an exit status, without a traceback.

    Around a command's main function, as a decorator or in a ``with``. Exits with 2 for most :class:`UserError`, a full
    disk or a missing permission, with 130 for an interrupt, and with 75 (to be started again) for SIGTERM. Any other
    exception is a bug and keeps its traceback.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files need not be text
    try:
        with sigterm_stops():
            yield
    except KeyboardInterrupt:
        _exit("interrupted; the same command resumes", 130)
    except Preempted as stop:
        _exit(str(stop), os.EX_TEMPFAIL)
    except UserError as error:
        _exit(f"error: {error}", error.status)
    except Exception as error:
        cure = _cure(error)
        if cure is None:
            raise
        _exit(f"error: {cure}", 2)


def _cure(error: Exception) -> str | None:
    where = f" at {error.filename}" if isinstance(error, OSError) and error.filename else ""
    # Orbax, TensorStore and ArrayRecord report a full disk in errors of their own.
    if getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT) or "No space left on device" in str(error):
        return f"disk full{where}; free some space or choose another directory: the same command resumes"
    if isinstance(error, PermissionError) or getattr(error, "errno", None) == errno.EROFS:
        return f"no permission to write or read{where}; choose another directory or change its owner"
    return None


def _exit(line: str, status: int) -> None:
    print(" ".join(line.split()), file=sys.stderr)
    jax = sys.modules.get("jax")
    if status == UserError.status and jax is not None and jax.distributed.is_initialized():
        # At exit, jax would wait in vain for the other processes and then abort with a status of its own.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    raise SystemExit(status)
