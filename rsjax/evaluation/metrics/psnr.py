"""PSNR of frames with values 0–255 (uint8, or floats on the same scale)."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num

from rsjax.clip import Array
from rsjax.evaluation.registry import PerFrame, Scene, Scores, metric

PEAK = 255.0
PSNR_CAP = 100.0  # dB; the score of identical frames


def per_frame(scene: Scene) -> PerFrame:
    """Scores every predicted frame."""
    return np.asarray(psnr(scene.truth.rgb, scene.prediction.rgb))[:, scene.prompt_frames :]


@metric("psnr", "PSNR", unit="dB", better="higher", decimals=2, watch=True, per_frame=per_frame)
def score(scene: Scene) -> Scores:
    """Returns the mean over each clip's predicted frames, and over the second half of them as ``_second_half``."""
    frames = scene.shared(per_frame)
    return {"": frames.mean(-1), "_second_half": frames[:, frames.shape[-1] // 2 :].mean(-1)}


def same_frames(truth: Num[Array, "*B H W C"], prediction: Num[Array, "*B H W C"]) -> tuple[Array, Array]:
    """Checks that two videos have the same shape, and returns both as float32.

    Raises:
        ValueError: the shapes differ, or are not [..., H, W, C].
    """
    truth = jnp.asarray(truth)
    prediction = jnp.asarray(prediction)
    if truth.shape != prediction.shape or truth.ndim < 3:
        raise ValueError(
            f"frames to compare have shapes {truth.shape} and {prediction.shape}; both must be the same [..., H, W, C]"
        )
    return truth.astype(jnp.float32), prediction.astype(jnp.float32)


@jax.jit
def psnr(truth: Num[Array, "*B H W C"], prediction: Num[Array, "*B H W C"]) -> Float[Array, "*B"]:
    """Returns the peak signal-to-noise ratio of each frame in dB: 10·log₁₀(255² / MSE) over pixels and channels.

    It is capped at ``PSNR_CAP`` (100 dB), the score of identical frames.

    Raises:
        ValueError: the shapes differ, or are not [..., H, W, C].
    """
    truth, prediction = same_frames(truth, prediction)
    mse = jnp.mean((truth - prediction) ** 2, axis=(-3, -2, -1))
    return 10 * jnp.log10(PEAK**2 / jnp.maximum(mse, PEAK**2 * 10 ** (-PSNR_CAP / 10)))
