"""The choice of clips for the report."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.evaluation.shown import choose_clips, extremes

PSNR = np.array([20.0, 14.0, 23.0, 21.0, 30.0, 16.0, 20.5, 22.0])  # median 20.75
SUCCESS = np.array([False, True, True, False, True, False, False, True])


def test_half_are_nearest_to_the_median_and_half_the_worst() -> None:
    rows, ranks = choose_clips(PSNR, SUCCESS, 7)
    assert rows[1::2].tolist() == [1, 5, 0]
    assert ranks.tolist() == [0, 1, 0, 2, 0, 3, 0]
    # Successes are 1.25 (clip 7) and 2.25 (clip 2) from the median, failures 0.25 (clips 3 and 6).
    assert rows[::2].tolist() == [7, 3, 2, 6]


def test_the_ends_by_hand() -> None:
    lowest, highest = extremes(PSNR, 2)
    assert (lowest.tolist(), highest.tolist()) == ([1, 5], [4, 2])
    assert [rows.tolist() for rows in extremes(PSNR[:3], 2)] == [[1], [2]], "no clip at both ends"


def test_without_failures_the_nearest_are_typical() -> None:
    rows, _ = choose_clips(PSNR, np.ones(8, bool), 4)
    assert set(rows[::2]) == {3, 6}


@settings(max_examples=50, deadline=None)
@given(clips=st.integers(1, 12), count=st.integers(1, 15), seed=st.integers(0, 99))
def test_no_clip_is_shown_twice_and_none_left_out_is_worse(clips: int, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    psnr = rng.integers(15, 20, clips).astype(float)
    rows, ranks = choose_clips(psnr, rng.random(clips) < 0.5, count)
    assert len(set(rows.tolist())) == len(rows) == min(count, clips)
    worst = rows[ranks > 0]
    assert len(worst) == len(rows) // 2
    assert (np.diff(psnr[worst]) >= 0).all()
    others = np.setdiff1d(np.arange(clips), worst)
    assert psnr[others].min() >= psnr[worst].max(initial=0)
