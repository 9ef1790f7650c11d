import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rsjax.data.normalization import Statistics
from rsjax.errors import UserError

FLOATS = st.floats(-100, 100, width=32)
ROWS = hnp.arrays(np.float32, st.tuples(st.integers(2, 20), st.integers(1, 4)), elements=FLOATS)


@given(ROWS, ROWS)
def test_statistics_of_parts_are_those_of_the_whole(left: np.ndarray, right: np.ndarray) -> None:
    right = np.resize(right, (len(right), left.shape[1]))
    parts, whole = Statistics.of(left).merged(Statistics.of(right)), np.concatenate([left, right]).astype(np.float64)
    stored = Statistics.from_json(json.loads(json.dumps(parts.to_json()))).to_json()
    for name, expected in {
        "mean": whole.mean(0),
        "std": whole.std(0),
        "min": whole.min(0),
        "max": whole.max(0),
    }.items():
        np.testing.assert_allclose(stored[f"action_{name}"], expected, atol=1e-6)
    assert stored["action_count"] == len(whole)


def test_statistics_of_actions_of_other_lengths_do_not_merge() -> None:
    with pytest.raises(UserError, match="actions of 3 dimensions among such of 2"):
        Statistics.of(np.zeros((3, 2))).merged(Statistics.of(np.zeros((1, 3))))
