"""Ghosts and morphing: none in what is right or still, and all of it in videos made so."""

import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.evaluation.metrics.failures import FLAGGED, likeness, moving_points
from rsjax.evaluation.registry import Scene
from tests.evaluation.metrics.scored import per_frame, score

FRAMES = 8
SIZE = 64


def texture(seed: int) -> np.ndarray:
    """A square of 20 pixels with blocks of 4 pixels in random colours."""
    blocks = np.random.default_rng(seed).integers(0, 256, (5, 5, 3))
    return blocks.repeat(4, 0).repeat(4, 1).astype(np.float32)


def sliding(*looks: np.ndarray) -> np.ndarray:
    """A square that moves by 3 pixels in every frame, on grey, and takes these looks one after another."""
    video = np.full((FRAMES, SIZE, SIZE, 3), 90, np.uint8)
    for t in range(FRAMES):
        place = t * (len(looks) - 1) / (FRAMES - 1)
        low = int(place)
        high = min(low + 1, len(looks) - 1)
        look = looks[low] + (place - low) * (looks[high] - looks[low])
        video[t, 20:40, 4 + 3 * t : 24 + 3 * t] = look.astype(np.uint8)
    return video


TRUE = sliding(texture(0))
STILL = np.repeat(TRUE[:1], FRAMES, 0)
GHOST = ((TRUE.astype(int) + STILL) // 2).astype(np.uint8)
MORPHED = sliding(texture(0), texture(1))


@pytest.mark.parametrize(
    ("made", "name", "shown"),
    [
        (TRUE, "ghost", False),
        (STILL, "ghost", False),
        (GHOST, "ghost", True),
        (TRUE, "morphing", False),
        (STILL, "morphing", False),
        (MORPHED, "morphing", True),
    ],
)
def test_each_failure_is_seen_where_it_is(made: np.ndarray, name: str, shown: bool) -> None:
    scene = Scene(Video(np.stack([TRUE, STILL])), Video(np.stack([made, STILL])))
    found, nothing_moves = score(name, scene)
    assert nothing_moves == 0
    assert found > 0.7 if shown else found < 0.05
    assert (found > FLAGGED[name]) == shown
    before = np.full((2, 1, SIZE, SIZE, 3), 30, np.uint8)  # another frame of the prompt
    videos = [np.concatenate([before, video.rgb], axis=1) for video in (scene.truth, scene.prediction)]
    later = Scene(Video(videos[0]), Video(videos[1]), prompt_frames=2)
    np.testing.assert_array_equal(score(name, later), [found, nothing_moves])


def test_ghosts_are_pixels_on_the_way_from_before_to_now() -> None:
    """By hand: a red pixel that turns blue; a quarter, half and all of the way, and another colour."""
    truth = np.zeros((1, 2, 1, 4, 3), np.uint8)
    truth[:, 0] = (200, 0, 0)
    truth[:, 1] = (0, 0, 200)
    made = truth.copy()
    made[0, 1, 0] = [(100, 0, 100), (0, 0, 200), (190, 0, 10), (100, 200, 100)]
    assert per_frame("ghost", Scene(Video(truth), Video(made))).tolist() == [[0.25]]


def test_points_lie_where_something_moves_and_keep_their_look_in_the_true_clip() -> None:
    points = moving_points(TRUE)
    assert len(points) > 8
    assert (points[:, 0] < 50).all() and (abs(points[:, 1] - 30) < 14).all()
    assert (likeness(TRUE, points) > 0.7).mean() > 0.8
    assert not len(moving_points(STILL)) and not len(likeness(TRUE, moving_points(STILL)))
