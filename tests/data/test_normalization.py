import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rsjax.data.normalization import Normalization, Statistics
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


WIDTH = 4
NORMALIZATION = Normalization(tuple(np.linspace(-1, 1, WIDTH)), (0.0, *np.linspace(0.1, 2, WIDTH - 1)), None)


@given(seed=st.integers(0, 99), frames=st.integers(2, 6), clips=st.integers(1, 3))
def test_action_inputs_are_undone_by_mean_and_deviation_and_begin_with_zeros(
    seed: int, frames: int, clips: int
) -> None:
    actions = np.random.default_rng(seed).normal(size=(clips, frames, WIDTH)).astype(np.float32)
    before = actions.copy()
    inputs = NORMALIZATION.action_inputs(actions, integrate=False)
    assert inputs.dtype == np.float32
    assert not inputs[:, 0].any()
    # The first dimension has no deviation: it is divided by 0.001, not by 0.
    back = inputs[:, 1:] * np.array([1e-3, *NORMALIZATION.action_std[1:]]) + NORMALIZATION.action_mean
    np.testing.assert_allclose(back, actions[:, 1:], atol=1e-5)
    np.testing.assert_array_equal(actions, before)
    assert NORMALIZATION.action_inputs(actions[0], integrate=False).tolist() == inputs[0].tolist()


def test_integrated_actions_follow_the_plain_ones_and_their_differences_are_these() -> None:
    actions = np.random.default_rng(0).normal(size=(2, 5, WIDTH)).astype(np.float32)
    plain, both = (NORMALIZATION.action_inputs(actions, integrate=value) for value in (False, True))
    np.testing.assert_array_equal(both[..., :WIDTH], plain)
    np.testing.assert_allclose(np.diff(both[..., WIDTH:], axis=-2) * 4, plain[:, 1:], rtol=1e-3, atol=1e-3)
    assert not both[:, 0].any()
