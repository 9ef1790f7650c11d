from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.data.clips import frame_rate, spread


@given(st.integers(1, 500), st.integers(1, 60))
def test_numbers_are_spread_evenly_from_the_first_to_the_last(size: int, count: int) -> None:
    numbers = spread(range(size), count)
    assert len(numbers) == min(size, count) and numbers == sorted(set(numbers))
    assert numbers[0] == 0 and numbers[-1] == (size - 1 if count > 1 else 0)
    steps = np.diff(numbers)
    assert not len(steps) or steps.max() - steps.min() <= 1


@pytest.mark.parametrize(
    ("origin", "rate"),
    [
        ({"fps": 30, "frames": [0, 6, 12]}, 5.0),
        ({"control_hz": 20, "control_steps": 4}, 5.0),
        ({"fps": 30, "frames": 120}, None),
        ({"fps": 30, "frames": [7, 7]}, None),
        ({"fps": "30 Hz", "frames": [0, 1]}, None),
        ({"control_hz": "fast", "control_steps": 4}, None),
        ({}, None),
    ],
)
def test_a_provenance_that_somebody_else_wrote_has_no_rate(origin: dict[str, Any], rate: float | None) -> None:
    assert frame_rate({"provenance": origin}, {}) == rate
