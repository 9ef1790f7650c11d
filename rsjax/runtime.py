"""What has to be settled about the process before JAX is loaded."""

import os
import sys

TUNABLE = "glibc.malloc.hugetlb=1"


def prefer_huge_pages() -> None:
    """Restarts the program, once, with glibc's allocator asking for huge pages.

    XLA's CPU backend takes fresh memory for every step, and touching it 4 KiB at a time is a quarter of a small model's
    step. glibc reads its tunables only when a process starts, hence the restart (same process id, same arguments).
    Does nothing where glibc is not the C library, or where the user has set the tunable.
    """
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if not sys.platform.startswith("linux") or "glibc.malloc.hugetlb" in tunables or not sys.orig_argv:
        return
    environment = os.environ | {"GLIBC_TUNABLES": f"{tunables}:{TUNABLE}".lstrip(":")}
    sys.stdout.flush()
    os.execve(sys.executable, sys.orig_argv, environment)  # noqa: S606
