"""What has to be settled about the process before JAX is loaded."""

import os
import sys

HUGE_PAGES = "glibc.malloc.hugetlb=1"
MOST_CPU_DEVICES = 8


def tune_process() -> None:
    """Restarts the program, once, in an environment in which JAX is fast on CPUs (same process id and arguments).

    - glibc's allocator asks for huge pages: XLA's CPU backend takes fresh memory for every step, and touching it 4 KiB
      at a time is a quarter of a small model's step. glibc reads its tunables only when a process starts.
    - JAX sees a CPU device per core, for data-parallel training: many of a small model's operations run on one core,
      and two devices do them side by side.

    What the user has set in ``GLIBC_TUNABLES``, ``JAX_NUM_CPU_DEVICES`` or ``XLA_FLAGS`` stays. GPUs and TPUs are not
    affected.
    """
    if not sys.platform.startswith("linux"):
        return
    wanted = {}
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if "glibc.malloc.hugetlb" not in tunables:
        wanted["GLIBC_TUNABLES"] = f"{tunables}:{HUGE_PAGES}".lstrip(":")
    if "host_platform_device_count" not in os.environ.get("XLA_FLAGS", "") and "JAX_NUM_CPU_DEVICES" not in os.environ:
        wanted["JAX_NUM_CPU_DEVICES"] = str(min(len(os.sched_getaffinity(0)), MOST_CPU_DEVICES))
    if wanted:
        sys.stdout.flush()
        os.execve(sys.executable, sys.orig_argv, os.environ | wanted)
