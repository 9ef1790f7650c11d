"""Pictures, depth and tracks lie in a clip's square by one geometry."""

import cv2
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from rsjax.tools.ingest.pictures import Fit, Placement

FITS: list[Fit] = ["crop", "pad", "stretch"]
SIZE = 64


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(FITS), st.integers(40, 200), st.integers(40, 200), st.floats(0.2, 0.8), st.floats(0.2, 0.8))
@example("crop", 40, 47, 0.5, 0.5)  # an odd width, of which the depth camera has half, rounded down
def test_a_spot_its_depth_and_its_track_stay_in_one_place(
    fit: Fit, height: int, width: int, x: float, y: float
) -> None:
    """The depth camera has half the resolution of the other."""
    row = int(y * height) // 2 * 2
    column = int(x * width) // 2 * 2
    picture = np.zeros((height, width, 3), np.uint8)
    cv2.circle(picture, (column, row), 6, (255, 255, 255), -1)
    depth = np.ones((height // 2, width // 2), np.float32)
    cv2.circle(depth, (column // 2, row // 2), 3, 2.0, -1)
    placement = Placement.create(fit, height, width, SIZE)
    point = np.array([[[(column + 0.5) / width, (row + 0.5) / height]]])
    (track,), (visible,) = placement.tracks(point, np.ones((1, 1), bool))
    bright = placement.picture(picture)[..., 0]
    far = placement.picture(depth)
    assert bright.shape == far.shape == (SIZE, SIZE)
    if not ((track > 0.15) & (track < 0.85)).all():
        return  # the spot is cut off, or too near to the edge to have its middle there
    assert visible.all()
    coarsest = SIZE / (min(height, width) // 2)  # a pixel of the depth camera, in those of the result
    for weights in (bright, far == 2):
        middle = np.array([np.average(axis, weights=weights) for axis in np.indices(weights.shape)[::-1]])
        np.testing.assert_allclose((middle + 0.5) / SIZE, track[0], atol=max(2.5, coarsest) / SIZE)


@settings(max_examples=60)
@given(st.integers(1, 300), st.integers(1, 300), st.integers(8, 64))
def test_a_crop_is_the_middle_square_and_hides_points_outside_it(height: int, width: int, size: int) -> None:
    assume(height != width)
    picture = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    side = min(height, width)
    top = (height - side) // 2
    left = (width - side) // 2
    placement = Placement.create("crop", height, width, size)
    middle = picture[top : top + side, left : left + side]
    np.testing.assert_array_equal(placement.picture(picture), cv2.resize(middle, (size, size), None, 0, 0, 3))
    ends = np.array([[left + side / 4, top + side / 2], [left - 1, top - 1], [left + side + 1, top + side + 1]])
    points, visible = placement.tracks((ends / [width, height])[:, None], np.ones((3, 1), bool))
    np.testing.assert_allclose(points[0, 0], [0.25, 0.5], atol=1e-6)
    assert visible[:, 0].tolist() == [True, False, False]


@settings(max_examples=60)
@given(st.integers(8, 300), st.integers(8, 300), st.integers(8, 64))
def test_bars_are_black_and_have_no_depth(height: int, width: int, size: int) -> None:
    placement = Placement.create("pad", height, width, size)
    depth = placement.picture(np.ones((height, width), np.float32))
    rgb = placement.picture(np.full((height, width, 3), 9, np.uint8))
    np.testing.assert_array_equal(depth > 0, (rgb == 9).all(-1))
    wide = max(1, round(size * width / max(height, width))), max(1, round(size * height / max(height, width)))
    assert (depth > 0).sum() == wide[0] * wide[1]
    points = np.array([[[0.0, 0.0], [1.0, 1.0]]])
    placed, visible = placement.tracks(points, np.ones((1, 2), bool))
    assert visible.all() and ((placed >= 0) & (placed <= 1 + 1e-6)).all()
    seen = np.argwhere(depth > 0)
    np.testing.assert_allclose(placed[0, :, ::-1] * size, [seen.min(0), seen.max(0) + 1], atol=1e-4)


@pytest.mark.parametrize("fit", FITS)
def test_square_pictures_are_only_shrunk(fit: Fit) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (48, 48, 3), np.uint8)
    placement = Placement.create(fit, 48, 48, 16)
    expected = cv2.resize(picture, (16, 16), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(placement.picture(picture), expected)
    points = np.array([[[0.3, 1.2]]], np.float32)
    seen = np.array([[True]])
    np.testing.assert_array_equal(placement.tracks(points, seen)[0], points)
    assert placement.tracks(points, seen)[1].all() and placement.words == ""


def test_words_have_the_sides_of_the_pictures() -> None:
    assert Placement.create("crop", 480, 640, 64).words.startswith("640 × 480 cropped to the middle square")
