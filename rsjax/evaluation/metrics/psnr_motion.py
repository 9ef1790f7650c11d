"""PSNR of the pixels that move in the true clip: a static background, which is easy to predict, does not count.

A pixel counts in a frame if, in this or an earlier predicted frame, the true clip differed from the last prompt frame
by more than 10 grey levels of 255, after the grey frames were blurred by a Gaussian of 5×5 pixels (the threshold and
blur of Physics-IQ). So a pixel still counts after things have moved away from it, and only the truth decides.
"""

import numpy as np
from jaxtyping import Bool, Float, UInt8

from rsjax.evaluation.metrics.physics_iq import THRESHOLD, grey
from rsjax.evaluation.metrics.psnr import PEAK, PSNR_CAP
from rsjax.evaluation.registry import PerClip, PerFrame, Scene, Unavailable, metric


def per_frame(scene: Scene) -> PerFrame:
    """Scores every predicted frame; NaN before anything has moved."""
    truth, prediction = (video.rgb[:, scene.prompt_frames :] for video in (scene.truth, scene.prediction))
    return psnr_where(truth, prediction, scene.of_truth(_moved))


@metric("psnr_motion", "PSNR where it moves", unit="dB", better="higher", decimals=2, watch=True, per_frame=per_frame)
def score(scene: Scene) -> PerClip:
    """Returns the mean over the predicted frames that have a score; clips in which nothing moves are left out."""
    frames = scene.shared(per_frame)
    moving = frames[np.isfinite(frames).any(1)]
    if not len(moving):
        raise Unavailable(f"nothing moves in the test clips: no pixel changes by more than {THRESHOLD} grey levels")
    return np.nanmean(moving, axis=1)


def _moved(scene: Scene) -> Bool[np.ndarray, "B P H W"]:
    return np.stack([moved(video, scene.prompt_frames) for video in scene.truth.rgb])


def moved(frames: UInt8[np.ndarray, "T H W 3"], prompt_frames: int = 1) -> Bool[np.ndarray, "P H W"]:
    """Returns the pixels that have moved so far, for every frame after the prompt."""
    start, *later = (grey(frame).astype(np.int16) for frame in frames[prompt_frames - 1 :])
    return np.logical_or.accumulate(np.abs(np.stack(later) - start) > THRESHOLD, axis=0)


def psnr_where(
    truth: UInt8[np.ndarray, "*B H W 3"], prediction: UInt8[np.ndarray, "*B H W 3"], mask: Bool[np.ndarray, "*B H W"]
) -> Float[np.ndarray, "*B"]:
    """Returns the PSNR in dB over the masked pixels of each frame, at most 100 dB; NaN without masked pixels."""
    squares = np.square(truth.astype(np.float32) - prediction.astype(np.float32)).mean(-1)
    pixels = mask.sum((-2, -1))
    mse = np.where(mask, squares, 0).sum((-2, -1), dtype=np.float64) / np.maximum(pixels, 1)
    scores = 10 * np.log10(PEAK**2 / np.maximum(mse, PEAK**2 * 10 ** (-PSNR_CAP / 10)))
    return np.where(pixels > 0, scores, np.nan)
