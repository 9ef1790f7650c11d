"""Physics-IQ against its definition in plain numpy, and on cases computed by hand."""

from typing import Any

import cv2
import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.evaluation.metrics.physics_iq import (
    Four,
    Small,
    four_metrics,
    motion_masks,
    physics_iq_score,
    shrink,
    through_video,
)
from rsjax.evaluation.registry import Scene, Unavailable
from tests.evaluation.metrics.scored import per_frame, score


def drifting(seed: int, frames: int = 9, size: int = 64) -> np.ndarray:
    """A noisy picture on which two squares move, one of them slowly."""
    rng = np.random.default_rng(seed)
    base = cv2.resize(rng.integers(0, 256, (9, 9, 3), np.uint8), (size, size))
    video = np.stack([base] * frames)
    for t in range(frames):
        video[t, 5 + 4 * t : 21 + 4 * t, 8:26] = rng.integers(0, 256, 3)
        video[t, 20:44, 30 + t : 50 + t] = (240, 20, 90)
    return np.clip(video + rng.integers(-4, 5, video.shape), 0, 255).astype(np.uint8)


def windows(image: np.ndarray, mode: str, **fill: bool) -> np.ndarray:
    """The 5×5 pixels around every pixel."""
    padding: Any = {"mode": mode} | ({"constant_values": fill["outside"]} if fill else {})
    return np.lib.stride_tricks.sliding_window_view(np.pad(image, 2, **padding), (5, 5))


def masks_by_definition(frames: np.ndarray) -> np.ndarray:
    """evaluation.md §1 without OpenCV, except for its integer weights of grey."""
    taps = np.array([1, 4, 6, 4, 1])
    greys = []
    for frame in frames:
        red, green, blue = np.moveaxis(frame.astype(np.int64), -1, 0)
        plain = (red * 9798 + green * 19235 + blue * 3735 + 2**14) >> 15
        greys.append(((windows(plain, "reflect") * np.outer(taps, taps)).sum((-2, -1)) + 128) >> 8)
    average, masks = greys[0].astype(np.float64), [np.zeros(greys[0].shape, bool)]
    for image in greys[1:]:
        average = 0.7 * average + 0.3 * image
        mask = np.abs(image - np.rint(np.abs(average.astype(np.float32)))) > 10
        opened = dilated(eroded(mask))
        masks.append(eroded(dilated(opened)))
    return np.stack(masks)


def eroded(mask: np.ndarray) -> np.ndarray:
    return np.asarray(windows(mask, "constant", outside=True).all((-2, -1)))


def dilated(mask: np.ndarray) -> np.ndarray:
    return np.asarray(windows(mask, "constant", outside=False).any((-2, -1)))


def test_masks_are_the_definitions_bit_by_bit() -> None:
    frames = drifting(0)
    got = motion_masks(frames)
    np.testing.assert_array_equal(got, masks_by_definition(frames))
    assert 0.02 < got[1:].mean() < 0.6
    assert not got[0].any()


def test_the_threshold_is_strict_and_the_average_is_updated_first() -> None:
    """After a step of s grey levels the rounded average has moved by 0.3·s, so that 0.7·s is left."""
    step = lambda s: motion_masks(np.stack([np.zeros((16, 16, 3)), np.full((16, 16, 3), s)]).astype(np.uint8))[1]  # noqa: E731
    assert not step(14).any()  # |14 - round(4.2)| = 10
    assert step(15).all()  # |15 - round(4.5)| = 11: halves are rounded to even


def test_scores_of_masks_counted_by_hand() -> None:
    truth, other = np.zeros((2, 1, 3, 2, 2), bool)
    truth[0, 1] = [[1, 1], [0, 0]]
    truth[0, 2] = [[1, 0], [0, 0]]
    other[0, 1] = [[1, 0], [1, 0]]
    frames = np.zeros((1, 3, 2, 2, 3), np.uint8)
    bright = frames.copy()
    bright[0, 1] = 51  # 0.2 of 255
    bright[0, 2, 0, 0] = 255
    four = four_metrics(Small(truth, frames), Small(other, bright))
    assert four.spatial[0] == pytest.approx(1 / 3)
    np.testing.assert_allclose(four.spatiotemporal[0], [1, 1 / 3, 0])
    # Shares of frames: truth 2/3 and 1/3 above, prediction 1/3 left: Σmin = 1/3, Σmax = 2/3 + 1/3 + 1/3.
    assert four.weighted[0] == pytest.approx(1 / 4)
    np.testing.assert_allclose(four.mse[0], [0, 0.04, 0.25], rtol=1e-6)
    later = four_metrics(Small(truth, frames), Small(other, bright), first=1)
    np.testing.assert_allclose(later.spatiotemporal[0], [1 / 3, 0])
    assert (later.spatial[0], later.weighted[0]) == pytest.approx((1 / 3, 1 / 4)), "frame 0 has no mask"


def test_videos_without_motion_agree() -> None:
    still = shrink(np.full((1, 4, 16, 16, 3), 90, np.uint8))
    four = four_metrics(still, still)
    assert (four.spatial, four.weighted, four.spatiotemporal.min()) == (1, 1, 1)
    assert four.mse.max() == 0


def test_a_quarter_of_the_size_with_masks_made_binary_again() -> None:
    frames = drifting(4, size=48)
    small = shrink(frames[None])
    assert small.masks.shape == (1, 9, 12, 12)
    # Bilinear reduction by four reads the middle 2×2 of each 4×4 pixels; more than half of them must move.
    mask = motion_masks(frames).reshape(9, 12, 4, 12, 4)[:, :, 1:3, :, 1:3].mean((2, 4))
    np.testing.assert_array_equal(small.masks[0], mask > 127 / 255)
    middle = frames.reshape(9, 12, 4, 12, 4, 3)[:, :, 1:3, :, 1:3].astype(float).mean((2, 4))
    assert np.abs(small.frames[0] - middle).max() <= 0.5


def four(spatial: float, weighted: float, spatiotemporal: list[float], mse: list[float]) -> Four:
    return Four(np.array([spatial]), np.array([spatiotemporal]), np.array([weighted]), np.array([mse]))


def test_the_score_by_hand() -> None:
    takes = four(0.8, 0.5, [1.0, 0.6], [0.0, 0.02])
    made = four(0.4, 0.3, [1.0, 0.2], [0.01, 0.05])
    expected = 100 * ((0.6 / 0.8 + 0.4 / 0.8 + 0.3 / 0.5) / 3 - (0.03 - 0.01))
    assert physics_iq_score(made, takes) == pytest.approx(expected, abs=0.005)
    assert physics_iq_score(takes, takes) == 100
    assert physics_iq_score(four(1, 1, [1, 1], [0, 0]), takes) == 100, "clipped"
    assert physics_iq_score(four(0, 0, [0, 0], [0.9, 0.9]), takes) == 0
    for limits in (four(0, 0, [1, 0], [0, 0]), four(0.000004, 0.5, [1, 0.6], [0, 0])):
        with pytest.raises(Unavailable, match=r"have nothing in common \(spatial.* IoU 0\)"):
            physics_iq_score(made, limits)
    rough = four(0.8, 0.5, [0.50004, 0.50004], [0.01, 0.01])
    assert physics_iq_score(rough, takes) == physics_iq_score(four(0.8, 0.5, [0.5, 0.5], [0.01, 0.01]), takes)


def test_registered_scores_are_of_predicted_frames_and_of_all() -> None:
    truth, made = (np.stack([drifting(seed) for seed in seeds]) for seeds in ((0, 1), (2, 3)))
    scene = Scene(Video(truth), Video(made), prompt_frames=2, second_take=Video(truth[::-1].copy()))
    parts = {"": four_metrics(shrink(truth), shrink(made), 2), "_all_frames": four_metrics(shrink(truth), shrink(made))}
    for kind in ("spatial", "spatiotemporal", "weighted", "mse"):
        scores = score(f"physics_iq_{kind}", scene)
        for part, expected in parts.items():
            values = getattr(expected, kind)
            np.testing.assert_allclose(scores[part], values.mean(1) if values.ndim == 2 else values)
    for kind in ("spatiotemporal", "mse"):
        frames = per_frame(f"physics_iq_{kind}", scene)
        np.testing.assert_array_equal(frames, getattr(parts[""], kind))
    for kind in ("spatial", "weighted"):  # up to a frame: the score of videos that end there
        curve = per_frame(f"physics_iq_{kind}", scene)
        ends = [four_metrics(shrink(truth[:, :end]), shrink(made[:, :end]), 2) for end in range(3, truth.shape[1] + 1)]
        np.testing.assert_allclose(curve, np.stack([getattr(each, kind) for each in ends], 1))
        assert np.ptp(curve) > 0.01
    takes = four_metrics(shrink(truth), shrink(truth[::-1]))
    assert score("physics_iq_score", scene) == physics_iq_score(parts["_all_frames"], takes)


def test_without_a_second_take_or_pixels_there_is_a_reason() -> None:
    scene = Scene(Video(drifting(0)[None]), Video(drifting(1)[None]))
    with pytest.raises(Unavailable, match="no second take of the test clips"):
        score("physics_iq_score", scene)
    tiny = Video(np.zeros((1, 3, 3, 8, 3), np.uint8))
    with pytest.raises(Unavailable, match="frames of 3×8 pixels"):
        score("physics_iq_mse", Scene(tiny, tiny))


def test_scenes_of_one_truth_share_its_masks() -> None:
    cache: dict[Any, Any] = {}
    truth = Video(drifting(0)[None])
    for seed in (1, 2):
        score("physics_iq_mse", Scene(truth, Video(drifting(seed)[None]), truth_cache=cache))
    assert len(cache) == 1


def test_masks_as_published_pass_through_a_lossy_video() -> None:
    truth, made = (np.stack([drifting(seed) for seed in seeds]) for seeds in ((0, 1), (2, 3)))
    plain, stored = (shrink(truth, as_published) for as_published in (False, True))
    np.testing.assert_array_equal(plain.frames, stored.frames)
    changed = (plain.masks != stored.masks).mean()
    assert 0 < changed < 0.05
    for as_published in (False, True):
        scene = Scene(Video(truth), Video(made), as_published=as_published)
        expected = four_metrics(shrink(truth, as_published), shrink(made, as_published), 1)
        np.testing.assert_array_equal(score("physics_iq_spatiotemporal", scene)[""], expected.spatiotemporal.mean(1))  # type: ignore[index,call-overload]
    odd = (np.random.default_rng(0).random((4, 9, 7)) > 0.5).astype(np.uint8) * 255
    assert through_video(odd).shape == odd.shape
