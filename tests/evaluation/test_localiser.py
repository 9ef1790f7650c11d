"""The localiser on pictures of two squares, whose places are known."""

from typing import Any

import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.evaluation.evaluate import locating
from rsjax.evaluation.localiser import Localiser, recorded_places, train_localiser, varied
from rsjax.evaluation.metrics.localisation import cube_error, gripper_error, lifted_accuracy
from rsjax.evaluation.registry import Scene, Unavailable

SIDE, WIDTH, FRAMES = 16, 4, 8


def clip(seed: int) -> dict[str, Any]:
    """A red and a blue square; the cube is "lifted" in the upper half."""
    rng = np.random.default_rng(seed)
    rgb = np.full((FRAMES, SIDE, SIDE, 3), 200, np.uint8)
    corners = rng.integers(0, SIDE - WIDTH, (FRAMES, 2, 2))  # x, y of both squares
    corners[:, 1, 0] = (corners[:, 0, 0] + WIDTH + corners[:, 1, 0] // 2) % (SIDE - WIDTH)
    for frame, ((x, y), (u, v)) in zip(rgb, corners, strict=True):
        frame[v : v + WIDTH, u : u + WIDTH] = (0, 0, 255)
        frame[y : y + WIDTH, x : x + WIDTH] = (255, 0, 0)
    xy = (corners + WIDTH / 2) / SIDE
    objects = {"cube": xy[:, 0].tolist(), "gripper": xy[:, 1].tolist(), "cube_width": WIDTH / SIDE}
    return {"rgb": rgb, "success": xy[:, 0, 1] < 0.5, "provenance": {"objects": objects}}


@pytest.fixture(scope="module")
def localiser() -> Localiser:
    return train_localiser([clip(seed) for seed in range(100)], steps=75)


def scene(clips: list[dict[str, Any]], localiser: Localiser, shown: np.ndarray) -> Scene:
    """A scene whose video ends with these frames."""
    video = Video(np.stack([each["rgb"] for each in clips]))
    locate = locating(localiser, clips, FRAMES - 1)
    return Scene(video, video, located=locate(Video(shown[:, None]), True))


def test_places_are_read_within_a_fraction_of_a_width(localiser: Localiser) -> None:
    clips = [clip(seed) for seed in range(100, 160)]
    shown = scene(clips, localiser, np.stack([each["rgb"][-1] for each in clips]))
    for score, worst in ((cube_error, 0.3), (gripper_error, 0.5)):
        scores = score(shown)
        assert isinstance(scores, dict)
        assert np.median(scores[""]) < worst
        np.testing.assert_array_equal(scores[""], scores["_truth"])
    lifted = lifted_accuracy(shown)
    assert isinstance(lifted, dict)
    assert np.mean(lifted[""]) > 0.9


def test_a_picture_of_another_place_has_the_distance_as_its_error(localiser: Localiser) -> None:
    clips = [clip(seed) for seed in range(100, 160)]
    moved = np.roll(np.stack([each["rgb"][-1] for each in clips]), 1, axis=0)  # each gets its neighbour's frame
    scores = cube_error(scene(clips, localiser, moved))
    assert isinstance(scores, dict)
    xy = np.array([each["provenance"]["objects"]["cube"][-1] for each in clips])
    expected = np.linalg.norm(np.roll(xy, 1, axis=0) - xy, axis=-1) * SIDE / WIDTH
    assert np.median(np.abs(scores[""] - expected)) < 0.3
    assert np.median(scores["_truth"]) < 0.3


def test_varied_frames_show_their_objects_where_their_places_say() -> None:
    frames = np.zeros((20, 32, 48, 3), np.uint8)
    frames[:, 12:15, 20:25] = 200
    xy = np.full((20, 2, 2), [22.5 / 48, 13.5 / 32])
    images, places = varied(np.random.default_rng(0), frames, xy)
    np.testing.assert_allclose(images.sum((1, 2, 3)), frames.sum((1, 2, 3)), rtol=1e-4)
    rows, columns = np.mgrid[:32, :48] + 0.5
    weights = images[..., 0] / images[..., 0].sum((1, 2), keepdims=True)
    centres = np.stack([(weights * columns).sum((1, 2)) / 48, (weights * rows).sum((1, 2)) / 32], -1)
    np.testing.assert_allclose(places, np.stack([centres, centres], 1), atol=1e-4)
    brightest = images.max((1, 2, 3)).round()
    assert len({(*place.round(3), bright) for place, bright in zip(places[:, 0], brightest, strict=True)}) > 15
    assert np.ptp(places[:, 0] * (48, 32), axis=0).min() > 3


def test_training_depends_on_the_clips_alone() -> None:
    clips = [clip(seed) for seed in range(4)]
    frames = clips[0]["rgb"]
    one, other = (train_localiser(clips, steps=3)(frames) for _ in range(2))
    np.testing.assert_array_equal(one.xy, other.xy)


def test_clips_of_other_sources_have_no_places() -> None:
    assert recorded_places([clip(0), clip(1) | {"provenance": {}}]) is None
    video = Video(clip(0)["rgb"][None])
    with pytest.raises(Unavailable, match="do not say where cube and gripper are"):
        cube_error(Scene(video, video))
