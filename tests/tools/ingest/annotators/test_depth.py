import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rsjax.data.depth_color import depth_to_color
from rsjax.tools.ingest.annotators.depth import (
    RELATIVE_FAR,
    FilledDepths,
    fill_holes,
    inverse_of,
    metric_depth,
    relative_depth,
)
from rsjax.tools.ingest.episode import EpisodeError
from tests.tools.ingest.videos import ArrayFrames


def filled(depth, most_holes=0.5):
    return FilledDepths(ArrayFrames(depth), most_holes, "depth of top")


def test_depth_without_holes_stays_as_recorded():
    depth = np.random.default_rng(0).uniform(0.3, 2, (3, 8, 10)).astype(np.float32)
    np.testing.assert_array_equal(filled(depth).read([2, 0]), depth[[2, 0]])


@pytest.mark.parametrize("hole", [0.0, np.nan, np.inf])
def test_holes_take_the_nearest_measured_depth(hole):
    depth = np.full((3, 8, 10), 1.0, np.float32)
    depth[:, :, 5:] = 2.0
    depth[1, 3:5, 6:8] = hole
    depth[1, :, 0] = hole
    maps = filled(depth).read(range(3))
    np.testing.assert_array_equal(maps[1], maps[0])


def test_a_mostly_unmeasured_frame_is_refused():
    depth = np.ones((3, 8, 10), np.float32)
    depth[1, :6] = 0
    with pytest.raises(EpisodeError, match="depth of top, frame 1: 75%"):
        filled(depth).read(range(3))
    depth[1] = 0
    with pytest.raises(EpisodeError, match="100%"):
        filled(depth, 1.0).read(range(3))


@given(hnp.arrays(np.float32, (5, 6), elements=st.floats(0.5, 9, width=32)), hnp.arrays(bool, (5, 6)))
def test_filling_changes_holes_only_and_invents_no_depth(depth, holes):
    holes[0, 0] = False
    filled = fill_holes(np.where(holes, 0, depth), holes)
    np.testing.assert_array_equal(filled[~holes], depth[~holes])
    assert np.isin(filled, depth[~holes]).all()


@given(hnp.arrays(np.float32, (2, 3, 4), elements=st.floats(0, 1000, width=32)))
def test_relative_depth_can_be_undone(inverse):
    stretched = relative_depth(inverse)
    maps = stretched.maps.read(range(2))
    assert stretched.unit == "relative" and (maps >= 1 - 1e-6).all() and (maps <= RELATIVE_FAR * (1 + 1e-6)).all()
    spread = stretched.extent[1] - stretched.extent[0]
    np.testing.assert_allclose(inverse_of(stretched, range(2)), inverse, atol=1e-5 * spread + 1e-6, rtol=1e-5)


def test_colours_of_relative_depth_are_even_in_the_networks_output():
    inverse = np.linspace(3, 7, 766).reshape(1, 1, -1)
    colors = depth_to_color(relative_depth(inverse).maps.read([0]), 1.0, RELATIVE_FAR, "inverse")
    assert np.unique(np.diff(colors.sum(-1))).tolist() == [1.0]


def test_metric_depth_is_positive_and_nan_is_refused():
    assert metric_depth(np.array([[[-1.0, 2.0]]])).maps.read([0]).tolist() == [[[np.float32(1e-3), 2.0]]]
    for make in (metric_depth, relative_depth):
        with pytest.raises(ValueError, match="finite"):
            make(np.array([[[np.nan, 1.0]]]))
