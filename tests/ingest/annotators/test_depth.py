import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rsjax.data.depth_color import depth_to_color
from rsjax.ingest.annotators.depth import (
    RELATIVE_FAR,
    RecordedDepth,
    fill_holes,
    inverse_of,
    metric_depth,
    relative_depth,
)
from rsjax.ingest.episode import EpisodeError
from tests.ingest.videos import episode, sliding

FRAMES = sliding(3, (1, 0), (8, 10))


def test_recorded_depth_is_handed_on_in_metres():
    depth = np.random.default_rng(0).uniform(0.3, 2, (3, 8, 10)).astype(np.float32)
    given = RecordedDepth()(episode(FRAMES, depth=depth), "top")
    np.testing.assert_array_equal(given.maps.read([2, 0]), depth[[2, 0]])
    assert given.unit == "metres" and given.extent == (depth.min(), depth.max())


def test_without_a_depth_camera_there_is_none():
    assert RecordedDepth()(episode(FRAMES), "top") is None


@pytest.mark.parametrize("hole", [0.0, np.nan, np.inf])
def test_holes_take_the_nearest_measured_depth(hole):
    depth = np.full((3, 8, 10), 1.0, np.float32)
    depth[:, :, 5:] = 2.0
    depth[1, 3:5, 6:8] = hole
    depth[1, :, 0] = hole
    maps = RecordedDepth()(episode(FRAMES, depth=depth), "top").maps.read(range(3))
    np.testing.assert_array_equal(maps[1], maps[0])


def test_a_frame_that_is_mostly_unmeasured_is_an_error_of_the_episode():
    depth = np.ones((3, 8, 10), np.float32)
    depth[1, :6] = 0
    with pytest.raises(EpisodeError, match="frame 1: 75%"):
        RecordedDepth()(episode(FRAMES, depth=depth), "top")
    depth[1] = 0
    with pytest.raises(EpisodeError, match="100%"):
        RecordedDepth(most_holes=1.0)(episode(FRAMES, depth=depth), "top")


@given(hnp.arrays(np.float32, (5, 6), elements=st.floats(0.5, 9, width=32)), hnp.arrays(bool, (5, 6)))
def test_filling_changes_holes_alone_and_invents_no_depth(depth, holes):
    holes[0, 0] = False
    filled = fill_holes(np.where(holes, 0, depth), holes)
    np.testing.assert_array_equal(filled[~holes], depth[~holes])
    assert np.isin(filled, depth[~holes]).all()


@settings(deadline=None)
@given(hnp.arrays(np.float32, (2, 3, 4), elements=st.floats(0, 1000, width=32)))
def test_relative_depth_can_be_undone(inverse):
    given = relative_depth(inverse)
    maps = given.maps.read(range(2))
    assert given.unit == "relative" and (maps >= 1 - 1e-6).all() and (maps <= RELATIVE_FAR * (1 + 1e-6)).all()
    spread = given.extent[1] - given.extent[0]
    np.testing.assert_allclose(inverse_of(given, range(2)), inverse, atol=1e-5 * spread + 1e-6, rtol=1e-5)


def test_colours_of_relative_depth_are_even_in_what_the_network_said():
    inverse = np.linspace(3, 7, 766).reshape(1, 1, -1)
    colors = depth_to_color(relative_depth(inverse).maps.read([0]), 1.0, RELATIVE_FAR, "inverse")
    assert np.unique(np.diff(colors.sum(-1))).tolist() == [1.0]


def test_metric_depth_is_positive_and_what_is_not_finite_is_refused():
    assert metric_depth(np.array([[[-1.0, 2.0]]])).maps.read([0]).tolist() == [[[np.float32(1e-3), 2.0]]]
    for make in (metric_depth, relative_depth):
        with pytest.raises(ValueError, match="finite"):
            make(np.array([[[np.nan, 1.0]]]))
