from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.tools.ingest.annotators.protocols import Tracked
from rsjax.tools.ingest.annotators.tracks import LucasKanade, grid_points, track_in_spans, window_tracks
from tests.tools.ingest.videos import ArrayFrames, sliding, texture


@pytest.mark.parametrize("step", [(0, 0), (2, 0), (0, -3), (-1, 2)])
def test_points_on_a_sliding_picture_slide_with_it(step):
    frames = sliding(6, step)
    points = grid_points(6, np.zeros((0, 2)))
    places, seen = LucasKanade().follow(frames.pictures, points)
    truth = points[:, None] + np.arange(6)[None, :, None] * np.array(step) / [64, 48]
    inside = ((truth > 0.2) & (truth < 0.8)).all((1, 2))
    assert inside.any() and seen[inside].all()
    assert np.abs((places - truth)[inside] * [64, 48]).max() < 0.2
    assert np.abs((places - truth)[seen] * [64, 48]).max() < 1


@pytest.mark.parametrize(("speed", "noise"), [(0.1, 0.0), (0.0, 2.0)])
def test_slow_motion_adds_up_and_noise_does_not(speed: float, noise: float) -> None:
    rng = np.random.default_rng(0)
    grey = cv2.GaussianBlur(texture(96, 96).astype(np.float32), (0, 0), 1)
    moved = [cv2.warpAffine(grey, np.array([[1, 0, speed * t], [0, 1, 0]]), (96, 96)) for t in range(33)]
    frames = np.stack(moved)[..., None].repeat(3, -1) + rng.normal(0, noise, (33, 96, 96, 1))
    tracked = LucasKanade()(ArrayFrames(frames.clip(0, 255).astype(np.uint8)))  # two spans
    first = tracked.points[:, 0]
    chosen = ((first > 0.2) & (first < 0.7)).all(1) & tracked.visible[:, 0] & tracked.visible[:, -1]
    assert chosen.sum() > 0.75 * 64  # of the grid's
    errors = np.abs(96 * (tracked.points[:, -1] - first) - [32 * speed, 0]).max(1)[chosen]
    assert np.median(errors) < 0.3 and np.mean(errors < 1) > 0.9


def test_a_point_that_leaves_the_picture_is_not_seen_there():
    frames = sliding(12, (4, 0))
    places, seen = LucasKanade().follow(frames.pictures, np.array([[0.9, 0.5]], np.float32))
    assert seen[0, 0] and not seen[0, -1]
    assert (places[seen] < 1).all()


def test_a_hidden_point_reappears_where_it_was_lost():
    picture = np.repeat(texture(48, 64)[..., None], 3, -1).astype(np.uint8)
    hidden = picture.copy()
    hidden[10:40, 10:40] = 255 - np.repeat(texture(30, 30, 5)[..., None], 3, -1).astype(np.uint8)
    point = np.array([[25 / 64, 25 / 48]], np.float32)
    places, seen = LucasKanade().follow(np.stack([picture, picture, hidden, hidden, picture]), point)
    assert seen[0].tolist() == [True, True, False, False, True]
    np.testing.assert_allclose(places[0], np.repeat(point, 5, 0), atol=1e-6)


def test_new_points_begin_where_none_is_left_and_the_others_go_on():
    frames = sliding(17, (2, 0))
    tracker = replace(LucasKanade(), grid=4, span=8)
    tracked = tracker(frames)
    assert len(tracked.points) > 16  # the left side emptied
    assert tracked.visible.any(1).all()
    assert not tracked.visible[16:, :8].any()
    through = tracked.visible[:16, -1]
    assert through.any()  # across the seam of two spans
    moved = (tracked.points[:16, 16] - tracked.points[:16, 0])[through] * [64, 48]
    np.testing.assert_allclose(moved, np.tile([32.0, 0.0], (through.sum(), 1)), atol=0.5)


@settings(max_examples=30)
@given(st.integers(1, 40), st.integers(1, 9), st.integers(1, 5), st.integers(0, 2**16))
def test_spans_cover_every_frame_once_whatever_their_length(count, span, grid, seed):
    rng = np.random.default_rng(seed)
    spans = []

    def follow(pictures, points, depth):
        spans.append(pictures[:, 0, 0, 0].tolist())
        seen = rng.random((len(points), len(pictures))) < 0.8
        seen[:, 0] = True
        return np.repeat(points[:, None], len(pictures), 1), seen

    pictures = np.broadcast_to(np.arange(count, dtype=np.uint8)[:, None, None, None], (count, 2, 2, 3))
    tracked = track_in_spans(ArrayFrames(pictures), follow, grid, span)
    assert [t for part in spans for t in part[1:]] == list(range(1, count))
    assert [part[0] for part in spans] == list(range(0, max(count - 1, 1), span))
    assert tracked.visible.any(1).all()
    for start in range(0, max(count - 1, 1), span):
        cells = (tracked.points[tracked.visible[:, start], start] * grid).astype(int)
        assert {*map(tuple, cells.tolist())} == {(x, y) for x in range(grid) for y in range(grid)}


def test_a_windows_tracks_are_visible_at_first_and_include_those_that_move_most():
    points = np.full((10, 6, 2), 0.5, np.float32)
    points[3, :, 0] = np.linspace(0.1, 0.9, 6)
    visible = np.ones((10, 6), bool)
    visible[4, 2] = False
    chosen = window_tracks(Tracked(points, visible), [2, 4], 4)
    assert chosen.points.shape == (4, 2, 2) and chosen.visible[:, 0].all()
    np.testing.assert_array_equal(chosen.points[0], points[3, [2, 4]])
    repeated = window_tracks(Tracked(points, visible), [2, 4], 30)
    assert repeated.points.shape == (30, 2, 2) and repeated.visible[:, 0].all()


def test_a_window_without_visible_points_is_refused():
    with pytest.raises(ValueError, match="frame 1"):
        window_tracks(Tracked(np.zeros((2, 3, 2), np.float32), np.zeros((2, 3), bool)), [1, 2], 4)
