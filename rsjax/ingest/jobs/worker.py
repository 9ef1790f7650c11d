"""Where a worker process begins. Imports nothing heavy, so that a worker is its parent's before it loads anything."""

import ctypes
import os
import signal
import sys
from multiprocessing.connection import Connection

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def begin(parent: int, pipe: Connection) -> None:
    """In a worker: what is sent first is a function and its arguments, which is called with ``pipe`` before them.

    Args:
        parent: the process that started this one, with which it ends.
        pipe: to the parent.
    """
    end_with(parent)
    try:
        work, arguments = pipe.recv()
    except (EOFError, OSError):  # the parent is gone, or has no use for this worker any more
        return
    work(pipe, *arguments)


def end_with(parent: int) -> None:
    """From now on this process is killed when its parent dies, even by SIGKILL, whatever it is doing then."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it died before that
        os._exit(1)
