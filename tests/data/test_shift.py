"""Moved copies of clips."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rsjax.data.shift import moved, moved_tracks


@given(st.integers(-3, 3), st.integers(-3, 3))
def test_a_picture_is_moved_as_a_loop_moves_it(right: int, down: int) -> None:
    images = np.random.default_rng(0).integers(0, 255, (2, 6, 7, 3))
    found = moved(images, right, down)
    for y, x in np.ndindex(6, 7):
        source = images[:, min(max(y - down, 0), 5), min(max(x - right, 0), 6)]
        np.testing.assert_array_equal(found[:, y, x], source)


def test_tracks_move_with_the_picture_and_are_hidden_outside() -> None:
    tracks = np.array([[[0.5, 0.5], [0.95, 0.2]]], np.float32)
    record = moved_tracks({"tracks": tracks, "visible": np.array([[True, True]])}, np.array([0.1, -0.1]))
    np.testing.assert_allclose(record["tracks"], [[[0.6, 0.4], [1.0, 0.1]]], atol=1e-6)
    assert record["visible"].tolist() == [[True, False]]
    assert record["tracks"].dtype == np.float32
