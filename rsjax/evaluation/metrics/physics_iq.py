"""The metrics of Physics-IQ (Motamed et al. 2025): where, when and how much a video moves, and its squared error.

A mask marks the pixels that move in each frame; masks and frames are compared at a quarter of their size. The masks
depend on the frame rate, because a frame is compared with a running average of the frames before it.

Axes: B clips, T frames, H×W pixels, h×w a quarter of them.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from rsjax.evaluation.registry import PerFrame, Scene, Scores, Unavailable, metric

THRESHOLD = 10  # grey levels of 255 above which a pixel moves
_KEPT = 0.7  # share of the running average that is kept in the next frame
_KERNEL = np.ones((5, 5), np.uint8)
_SHRINK = 4
PUBLIC_FPS = 30  # of the public code's videos of masks

Kind = Literal["spatial", "spatiotemporal", "weighted", "mse"]


@dataclass(frozen=True)
class Small:
    """Videos at the size at which they are compared.

    Attributes:
        masks: the pixels that move.
        frames: values 0–255.
    """

    masks: Bool[np.ndarray, "B T h w"]
    frames: UInt8[np.ndarray, "B T h w 3"]


@dataclass(frozen=True)
class Four:
    """The four metrics of B clips.

    Attributes:
        spatial: intersection over union of the pixels that ever move.
        spatiotemporal: intersection over union of the pixels that move in each frame.
        weighted: Σmin / Σmax over pixels of the share of frames in which each pixel moves.
        mse: each frame's mean squared difference, values 0–1.
    """

    spatial: Float[np.ndarray, " B"]
    spatiotemporal: Float[np.ndarray, "B T"]
    weighted: Float[np.ndarray, " B"]
    mse: Float[np.ndarray, "B T"]


def grey(frame: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
    """Returns a frame in grey, blurred by a Gaussian of 5×5 pixels."""
    return np.asarray(cv2.GaussianBlur(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), (5, 5), 0))


def motion_masks(frames: UInt8[np.ndarray, "T H W 3"]) -> Bool[np.ndarray, "T H W"]:
    """Returns the pixels that move: those that differ by more than ``THRESHOLD`` from the running average.

    No pixel moves in frame 0. The average is updated before the comparison, and rounded for the comparison. Then
    specks are removed (opening by 5×5 pixels) and gaps are filled (closing).
    """
    average = grey(frames[0]).astype(np.float64)
    masks = [np.zeros(average.shape, np.uint8)]
    for frame in map(grey, frames[1:]):
        cv2.accumulateWeighted(frame, average, 1 - _KEPT)
        moved = (cv2.absdiff(frame, cv2.convertScaleAbs(average)) > THRESHOLD).astype(np.uint8)
        opened = cv2.morphologyEx(moved, cv2.MORPH_OPEN, _KERNEL)
        masks.append(np.asarray(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, _KERNEL)))
    return np.stack(masks) > 0


def through_video(masks: UInt8[np.ndarray, "T H W"]) -> UInt8[np.ndarray, "T H W"]:
    """Returns masks of 0 and 255 as the public code reads them back from an MPEG-4 video, which loses details.

    An odd last row or column is dropped there; here it is written a second time and dropped again.

    Raises:
        Unavailable: OpenCV cannot write such videos.
    """
    height = masks.shape[1]
    width = masks.shape[2]
    even = np.pad(masks, ((0, 0), (0, height % 2), (0, width % 2)), mode="edge")
    with TemporaryDirectory() as folder:
        path = f"{folder}/masks.mp4"
        codec = cv2.VideoWriter.fourcc(*"mp4v")
        writer = cv2.VideoWriter(path, codec, PUBLIC_FPS, (even.shape[2], even.shape[1]), isColor=False)
        for frame in even:
            writer.write(frame)
        writer.release()
        reader = cv2.VideoCapture(path)
        frames = []
        while (read := reader.read())[0]:
            frames.append(read[1][:height, :width, 0])
        reader.release()
    if len(frames) != len(masks):
        raise Unavailable("OpenCV writes no MPEG-4 video here; score without --as-published")
    return np.stack(frames)


def shrink(videos: UInt8[np.ndarray, "B T H W 3"], as_published: bool = False) -> Small:
    """Makes the masks of videos, and resizes masks and frames to a quarter of their size with bilinear interpolation.

    Args:
        as_published: whether masks go through a lossy video first.

    Raises:
        Unavailable: the frames are smaller than 4×4 pixels.
    """
    height = videos.shape[2] // _SHRINK
    width = videos.shape[3] // _SHRINK
    if not height or not width:
        raise Unavailable(f"frames of {videos.shape[2]}×{videos.shape[3]} pixels; Physics-IQ takes a quarter of them")

    def resized(images: Iterable[np.ndarray]) -> np.ndarray:
        return np.stack([cv2.resize(image, (width, height)) for image in images])

    stored = through_video if as_published else np.asarray
    masks = np.stack([resized(stored(motion_masks(video) * np.uint8(255))) > 127 for video in videos])
    return Small(masks, np.stack([resized(video) for video in videos]))


def four_metrics(truth: Small, prediction: Small, first: int = 0) -> Four:
    """Scores the frames from ``first`` on. Where both masks are empty, the score is 1."""
    a = truth.masks[:, first:]
    b = prediction.masks[:, first:]
    one, other = (videos.frames[:, first:].astype(np.float32) / 255 for videos in (truth, prediction))
    return Four(
        spatial=_iou(np.any(a, axis=1), np.any(b, axis=1)),
        spatiotemporal=_iou(a, b),
        weighted=_iou(a.mean(1), b.mean(1)),
        mse=np.square(one - other).mean((2, 3, 4), dtype=np.float64),
    )


def _iou(one: np.ndarray, other: np.ndarray) -> Float[np.ndarray, "..."]:
    """Returns Σmin / Σmax over the last two axes, 1 where both are zero."""
    shared = np.minimum(one, other).sum((-2, -1))
    either = np.maximum(one, other).sum((-2, -1))
    return np.where(either == 0, 1.0, shared / np.where(either == 0, 1, either))


def physics_iq_score(prediction: Four, second_take: Four) -> float:
    """Returns Physics-IQ's own score, 0–100: how close a prediction comes to the agreement of two recordings.

    100·[(ST / ST₂ + S / S₂ + W / W₂) / 3 - (MSE - MSE₂)], clipped, where each symbol is a mean over all clips and
    frames and the index 2 marks the scores of a second take. As in the public code, the scores of single frames are
    rounded to 4 decimals, the second take's means to 4 (S₂ to 5), and the result to 2.

    Args:
        prediction: the model's metrics against the first take.
        second_take: the metrics of the second take against the first.

    Raises:
        Unavailable: ST₂, S₂ or W₂ is 0, because the motions of the two takes do not overlap.
    """
    mean = _means(prediction)
    limit = _means(second_take)
    limit = {name: round(value, 5 if name == "spatial" else 4) for name, value in limit.items()}
    if empty := [name for name, value in limit.items() if name != "mse" and not value]:
        raise Unavailable(f"the second take's motion and the first's have nothing in common ({', '.join(empty)} IoU 0)")
    ratios = [mean[name] / limit[name] for name in ("spatiotemporal", "spatial", "weighted")]
    return round(float(np.clip(100 * (np.mean(ratios) - (mean["mse"] - limit["mse"])), 0, 100)), 2)


def _means(four: Four) -> dict[str, float]:
    values = {name: getattr(four, name) for name in get_args(Kind)}
    return {name: float((each.round(4) if each.ndim == 2 else each).mean()) for name, each in values.items()}


def _small_truth(scene: Scene) -> Small:
    return shrink(scene.truth.rgb, scene.as_published)


def _second_take(scene: Scene) -> Four:
    if scene.second_take is None:
        raise Unavailable("no second take of the test clips, to which Physics-IQ's score compares the model")
    return four_metrics(scene.of_truth(_small_truth), shrink(scene.second_take.rgb, scene.as_published))


def _small(scene: Scene) -> Small:
    return shrink(scene.prediction.rgb, scene.as_published)


def _four(scene: Scene, first: int) -> Four:
    return four_metrics(scene.of_truth(_small_truth), scene.shared(_small), first)


def _register(kind: Kind, title: str, better: Literal["higher", "lower"], **settings: Any) -> None:
    """Registers one of the four metrics: over the predicted frames, and as ``_all_frames`` including the prompt."""

    @metric(f"physics_iq_{kind}", f"Physics-IQ {title}", better=better, column=False, **settings)
    def score(scene: Scene) -> Scores:
        parts = {"": scene.prompt_frames, "_all_frames": 0}
        scores = {part: getattr(scene.shared(_four, first), kind) for part, first in parts.items()}
        return {part: values if values.ndim == 1 else values.mean(1) for part, values in scores.items()}


def _masks(scene: Scene) -> tuple[Bool[np.ndarray, "B P h w"], Bool[np.ndarray, "B P h w"]]:
    """Returns the pixels that move in the predicted frames of truth and prediction."""
    truth = scene.of_truth(_small_truth)
    prediction = scene.shared(_small)
    return truth.masks[:, scene.prompt_frames :], prediction.masks[:, scene.prompt_frames :]


def spatial_frames(scene: Scene) -> PerFrame:
    """Scores what has moved up to every predicted frame; the last value is the clip's score."""
    one, other = (np.logical_or.accumulate(masks, axis=1) for masks in _masks(scene))
    return _iou(one, other)


def weighted_frames(scene: Scene) -> PerFrame:
    """Scores how often things have moved up to every predicted frame; the last value is the clip's score."""
    one, other = (np.cumsum(masks, axis=1) for masks in _masks(scene))  # counts: the ratio is that of the shares
    return _iou(one, other)


def spatiotemporal_frames(scene: Scene) -> PerFrame:
    """Scores what moves in every predicted frame."""
    return scene.shared(_four, scene.prompt_frames).spatiotemporal


def mse_frames(scene: Scene) -> PerFrame:
    """Scores the squared error of every predicted frame."""
    return scene.shared(_four, scene.prompt_frames).mse


_register("spatial", "spatial IoU", "higher", decimals=4, per_frame=spatial_frames)
_register("spatiotemporal", "spatiotemporal IoU", "higher", decimals=4, per_frame=spatiotemporal_frames)
_register("weighted", "weighted spatial IoU", "higher", decimals=4, per_frame=weighted_frames)
_register("mse", "MSE", "lower", decimals=4, per_frame=mse_frames)


@metric("physics_iq_score", "Physics-IQ score", better="higher", decimals=2, column=False)
def score(scene: Scene) -> Scores:
    """Scores all clips together, including their prompts."""
    return physics_iq_score(scene.shared(_four, 0), scene.of_truth(_second_take))
