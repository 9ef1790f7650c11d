"""What has to be settled about the process before JAX is loaded."""

import os
import sys

HUGE_PAGES = "glibc.malloc.hugetlb=1"


def tune_process() -> None:
    """Restarts the program, once, with glibc's allocator asking for huge pages (same process id and arguments).

    XLA's CPU backend takes fresh memory for every step, and touching it 4 KiB at a time is a quarter of a small model's
    step. glibc reads its tunables only when a process starts, hence the restart. Does nothing where the user has set
    this tunable, or off Linux.
    """
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if not sys.platform.startswith("linux") or "glibc.malloc.hugetlb" in tunables:
        return
    sys.stdout.flush()
    tuned = os.environ | {"GLIBC_TUNABLES": f"{tunables}:{HUGE_PAGES}".lstrip(":")}
    os.execve(sys.executable, sys.orig_argv, tuned)
