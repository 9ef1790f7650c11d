"""Timed runs, and the memory that they took."""

import resource
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax


def median_seconds(call: Callable[[], Any], budget: float, most: int = 20, least: int = 3) -> float:
    """Median wall time of ``call`` in seconds, after one run that is not counted (it compiles and warms caches).

    Args:
        call: returns the arrays that it made; they are waited for.
        budget: seconds after which no further run begins, once there are ``least``.
        most: runs at the most.
        least: runs at the least.
    """
    jax.block_until_ready(call())
    seconds: list[float] = []
    while len(seconds) < least or (len(seconds) < most and sum(seconds) < budget):
        began = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds)


def peak_memory_bytes() -> int:
    """High-water mark since the process began: of the device's memory, or, on a CPU, of the resident set."""
    stats = jax.local_devices()[0].memory_stats()
    if stats:
        return stats["peak_bytes_in_use"]
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024  # Linux counts in KiB
