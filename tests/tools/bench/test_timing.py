import resource
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rsjax.tools.bench import timing
from rsjax.tools.bench.timing import median_seconds, peak_memory_bytes


@pytest.mark.parametrize(
    ("most", "budget", "runs"), [(7, 1e9, 7), (7, 0.0, 3)], ids=["as many as allowed", "three where time is short"]
)
def test_one_run_warms_up_and_repetitions_end_with_their_number_or_the_time(
    most: int, budget: float, runs: int
) -> None:
    calls = []
    assert median_seconds(lambda: calls.append(0), budget, most) >= 0
    assert len(calls) == 1 + runs


def test_the_median_leaves_out_warm_up_and_one_slow_run(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, seconds = [0.0], iter([4.0, 0.25, 4.0, 0.25])

    def call() -> None:
        clock[0] += next(seconds)

    monkeypatch.setattr(timing, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    assert median_seconds(call, 1.0, most=3) == 0.25


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_peak_memory_grows_by_what_is_touched_and_stays() -> None:
    before = peak_memory_bytes()
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    np.ones((before - resident + 2**28) // 8)  # much more, as other threads may free some meanwhile
    assert before + 2**24 <= peak_memory_bytes() < before + 2**29
