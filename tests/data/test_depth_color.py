from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.data.depth_color import Scale, color_to_depth, depth_to_color

SCALES = get_args(Scale)
NEAR, FAR = 0.3, 4.0
UNIT = st.floats(0, 1, width=32)


def scaled(depth: np.ndarray | float, scale: Scale) -> np.ndarray:
    return np.asarray(depth if scale == "linear" else 1 / np.asarray(depth), np.float64)


def depth_at(share: float) -> np.ndarray:
    return np.array([NEAR + share * (FAR - NEAR)], np.float32)


@pytest.mark.parametrize("scale", SCALES)
@given(share=UNIT)
def test_a_round_trip_errs_by_half_a_level_at_most(scale: Scale, share: float) -> None:
    depth = depth_at(share)
    color = np.asarray(depth_to_color(depth, NEAR, FAR, scale))
    np.testing.assert_array_equal(color, color.astype(np.uint8))
    back = np.asarray(color_to_depth(color.astype(np.uint8), NEAR, FAR, scale))
    level = abs(scaled(NEAR, scale) - scaled(FAR, scale)) / 765
    assert abs(scaled(back, scale) - scaled(depth, scale)) <= 0.5 * level + 2e-6


@pytest.mark.parametrize("scale", SCALES)
@given(one=UNIT, other=UNIT, share=UNIT)
def test_a_blend_of_two_colours_is_a_depth_between(scale: Scale, one: float, other: float, share: float) -> None:
    colors = [np.asarray(depth_to_color(depth_at(x), NEAR, FAR, scale)) for x in (one, other)]
    ends = [float(color_to_depth(color, NEAR, FAR, scale)[0]) for color in colors]
    blend = float(color_to_depth(share * colors[0] + (1 - share) * colors[1], NEAR, FAR, scale)[0])
    assert min(ends) - 1e-5 <= blend <= max(ends) + 1e-5


@pytest.mark.parametrize("scale", SCALES)
@given(color=st.tuples(*[st.integers(0, 255)] * 3))
def test_every_colour_is_a_depth_within_the_range(scale: Scale, color: tuple[int, int, int]) -> None:
    depth = float(color_to_depth(np.array(color, np.uint8), NEAR, FAR, scale))
    assert NEAR * (1 - 1e-6) <= depth <= FAR * (1 + 1e-6)


@pytest.mark.parametrize("scale", SCALES)
def test_the_walk_goes_from_black_far_away_to_white_nearby_and_clips_beyond(scale: Scale) -> None:
    depth = np.array([100.0, FAR, NEAR, 0.01], np.float32)
    color = np.asarray(depth_to_color(depth, NEAR, FAR, scale))
    np.testing.assert_array_equal(color, [[0] * 3, [0] * 3, [255] * 3, [255] * 3])
    walk = np.asarray(depth_to_color(np.linspace(FAR, NEAR, 500, dtype=np.float32), NEAR, FAR, scale))
    assert np.all(np.diff(walk.sum(-1)) >= 0)
    assert np.all((walk[:, 1] == 0) | (walk[:, 0] == 255))  # red is full before yellow begins
    assert np.all((walk[:, 2] == 0) | (walk[:, 1] == 255))


def test_inverse_depth_is_finer_near_the_camera() -> None:
    near, far = np.array([0.50, 0.51], np.float32), np.array([3.50, 3.51], np.float32)
    assert np.ptp(depth_to_color(near, NEAR, FAR, "inverse").sum(-1)) > 5
    assert np.ptp(depth_to_color(far, NEAR, FAR, "inverse").sum(-1)) < 2


@pytest.mark.parametrize("scale", SCALES)
def test_no_depth_is_black(scale: Scale) -> None:
    colors = np.asarray(depth_to_color(np.array([0, NEAR, FAR], np.float32), NEAR, FAR, scale))
    assert colors[:, 0].tolist() == [0, 255, 0] and colors.dtype == np.float32
