"""Locks between processes, by file; one that is killed lets go of its own."""

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rsjax.data.store import StoreError, disk_guard
from rsjax.progress import note

LOOKS, LOOK_SECONDS = 5, 0.05  # before a lock that is not waited for counts as another's


@contextmanager
def lock(path: Path, wait: str = "") -> Iterator[bool]:
    """Holds the lock of this name, or gives False where another process does.

    The file stays: deleting it would let two processes hold locks of one name.

    Args:
        wait: wait for the lock, and say this where there is need to. Empty: do not wait.

    Raises:
        StoreError: the file system has no locks, or the file cannot be made.
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
        raise StoreError(
            f"{path}: this file system has no locks ({error.strerror}); choose a place on another"
        ) from error
    return True
