"""Depth has one colour map for viewing, whose scale is drawn."""

import numpy as np
import pytest

from rsjax.tools.studies.report.depth_view import SCALE, depth_range, depth_scale, depth_to_colors


def test_depth_colours_run_from_red_to_violet_and_clip():
    colors = depth_to_colors(np.array([0.1, 0.5, 1.0, 2.0, 9.0, np.nan, 0.0]), near=0.5, far=2.0).astype(int)
    np.testing.assert_array_equal(colors[0], colors[1])
    np.testing.assert_array_equal(colors[3], colors[4])
    assert colors[5].tolist() == colors[6].tolist() == [0, 0, 0]
    assert colors[1, 0] > colors[1, 2]
    assert colors[3, 2] > colors[3, 1]
    assert len(np.unique(colors[1:4], axis=0)) == 3
    middle = 1 / ((1 / 0.5 + 1 / 2.0) / 2)
    np.testing.assert_array_equal(depth_to_colors(np.array(middle), 0.5, 2.0), depth_to_colors(np.array(1.5), 1.2, 2.0))
    for near in (2.0, 0.0):
        with pytest.raises(ValueError, match="0 < near < far"):
            depth_to_colors(np.ones(3), near, 2.0)


def test_the_range_is_that_of_known_depth():
    depth = np.array([0.0, np.nan, *np.linspace(1, 2, 101)])
    assert depth_range(depth) == pytest.approx((1.01, 1.99))
    near, far = depth_range(np.full(5, 3.0))
    assert near < far
    with pytest.raises(ValueError, match="0 or NaN everywhere"):
        depth_range(np.zeros(3))


@pytest.mark.parametrize("width", [40, 300, 801])
def test_a_scale_has_all_colours_in_order_and_its_ends_below(width):
    scale = depth_scale(0.5, 2.0, width, "metres", (0, 0, 0))
    assert scale.shape == (SCALE, width, 3)
    ends = depth_to_colors(np.array([0.5, 2.0]), 0.5, 2.0)
    np.testing.assert_array_equal(scale[4, [0, -1]], ends)
    assert scale[16:, :25].max() > 150 and scale[16:, -25:].max() > 150
    assert (depth_scale(0.5, 3.0, width, "metres", (0, 0, 0))[16:] != scale[16:]).any()
    assert (depth_scale(0.5, 2.0, width, "relative", (0, 0, 0))[16:] != scale[16:]).any()
