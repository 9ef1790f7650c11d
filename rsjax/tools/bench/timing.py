"""Measures time and memory."""

import resource
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax


def median_seconds(call: Callable[[], Any], budget: float, most: int = 20, least: int = 3) -> float:
    """Returns the median wall time of ``call`` in seconds, after a warm-up run that compiles and fills caches.

    Args:
        call: returns its arrays, so that the time until they are ready is included.
        budget: seconds after which no further run begins, but at least ``least`` runs are timed.
        most: largest number of timed runs.
        least: smallest number of timed runs.
    """
    jax.block_until_ready(call())
    seconds: list[float] = []
    while len(seconds) < least or (len(seconds) < most and sum(seconds) < budget):
        began = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds)


def peak_memory_bytes() -> int:
    """Returns the peak device memory since the process began or, on a CPU, the peak resident set."""
    stats = jax.local_devices()[0].memory_stats()
    if stats:
        return stats["peak_bytes_in_use"]
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024  # Linux counts in KiB
