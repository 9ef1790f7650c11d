"""Settings of the process that come before JAX is imported."""

import faulthandler
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from rsjax.errors import Preempted

HUGE_PAGES = "glibc.malloc.hugetlb=1"


def tune_process() -> None:
    """Restarts the program once, with the same process id and arguments, so that glibc allocates huge pages.

    XLA's CPU backend allocates fresh memory for every step, and touching it 4 KiB at a time takes a quarter of a small
    model's step. glibc reads its tunables only when a process starts, hence the restart. Does nothing if the user has
    set this tunable, or off Linux.
    """
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if not sys.platform.startswith("linux") or "glibc.malloc.hugetlb" in tunables:
        return
    sys.stdout.flush()
    tuned = os.environ | {"GLIBC_TUNABLES": f"{tunables}:{HUGE_PAGES}".lstrip(":")}
    os.execve(sys.executable, sys.orig_argv, tuned)


@contextmanager
def sigterm_stops() -> Iterator[None]:
    """Wraps a command: SIGTERM, by which schedulers end a process, raises :class:`Preempted`.

    The command then exits with status 75 (EX_TEMPFAIL), at which a scheduler starts it again. Training loops save first
    (:mod:`rsjax.training.preemption`). SIGUSR1 prints the stack of every thread. Does nothing off the main thread, the
    only one that may handle signals.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        raise Preempted("stopped by SIGTERM; the same command resumes")

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    faulthandler.register(signal.SIGUSR1, file=2)
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
