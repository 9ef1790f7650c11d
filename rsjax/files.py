"""Files that other processes and later runs read: whole or not at all, locked, and with clear errors on a full disk."""

import errno
import fcntl
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rsjax.errors import UserError
from rsjax.progress import note

LOOKS, LOOK_SECONDS = 5, 0.05  # before a lock that is not waited for counts as another's


class FileError(UserError):
    """A file that cannot be read or written. The message names it and the cure."""


def replace_directory(new: Path, path: Path) -> None:
    """Move a finished directory to its place; an older one there is gone only after that."""
    old = path.with_name(f"{path.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if path.exists():
        os.replace(path, old)
    os.replace(new, path)
    shutil.rmtree(old, ignore_errors=True)


def write_atomically(path: Path, payload: bytes) -> None:
    """Write a file that a reader sees whole or not at all."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(payload)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def disk_guard(path: Path) -> Iterator[None]:
    """Turn the operating system's full disk or refused write into a :class:`FileError` that names the place."""
    try:
        yield
    except OSError as error:
        raise _explain(path, error) from error
    except (RuntimeError, ValueError) as error:  # how ArrayRecord reports them
        if "No space left" in str(error):
            raise _explain(path, OSError(errno.ENOSPC, "")) from error
        raise


def _explain(path: Path, error: OSError) -> FileError:
    if error.errno == errno.ENOSPC:
        return FileError(f"{path}: the disk is full; free some space there and run again")
    return FileError(f"{path}: cannot write ({error}); check the place and its permissions")


@contextmanager
def lock(path: Path, wait: str = "") -> Iterator[bool]:
    """Holds the lock of this name, or gives False where another process does.

    The file stays: deleting it would let two processes hold locks of one name.

    Args:
        wait: wait for the lock, and say this where there is need to. Empty: do not wait.

    Raises:
        FileError: the file system has no locks, or the file cannot be made.
    """
    with disk_guard(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        held = _take(handle, path, fcntl.LOCK_EX | fcntl.LOCK_NB)
        for _ in range(LOOKS):  # it may only be looked at
            if held or wait:
                break
            time.sleep(LOOK_SECONDS)
            held = _take(handle, path, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not held and wait:
            note(wait)
            held = _take(handle, path, fcntl.LOCK_EX)
        yield held
    finally:
        os.close(handle)


def is_held(path: Path) -> bool:
    """Whether another holds the lock of this name. Nothing is made where there is none."""
    if not path.exists():
        return False
    handle = os.open(path, os.O_RDONLY)
    try:
        return not _take(handle, path, fcntl.LOCK_SH | fcntl.LOCK_NB)  # so that lookers do not see each other
    finally:
        os.close(handle)


def _take(handle: int, path: Path, how: int) -> bool:
    try:
        fcntl.flock(handle, how)
    except BlockingIOError:
        return False
    except OSError as error:
        raise FileError(
            f"{path}: this file system has no locks ({error.strerror}); choose a place on another"
        ) from error
    return True
