"""Waits for what another thread or process does."""

import time
from collections.abc import Callable

SECONDS = 120.0  # far more than anything takes that the tests wait for


def wait_until(condition: Callable[[], bool], seconds: float = SECONDS) -> None:
    """Returns as soon as a condition is true.

    Raises:
        AssertionError: it is not after so many seconds.
    """
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"not true after {seconds:.0f} s"
        time.sleep(0.01)
