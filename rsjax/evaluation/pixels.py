"""PSNR and SSIM of frames whose values lie in 0–255 (uint8, or floats on the same scale).

Both give one number per frame. Average over a clip's predicted frames first
(:func:`rsjax.evaluation.statistics.over_predicted_frames`) and over clips after.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num

from rsjax.clip import Array

PEAK = 255.0
PSNR_CAP = 100.0  # dB; what identical frames score

_WINDOW = 11
_SIGMA = 1.5
_K1 = 0.01
_K2 = 0.03


def _same_frames(truth: Num[Array, "*B H W C"], prediction: Num[Array, "*B H W C"]) -> tuple[Array, Array]:
    truth, prediction = jnp.asarray(truth), jnp.asarray(prediction)
    if truth.shape != prediction.shape or truth.ndim < 3:
        raise ValueError(
            f"frames to compare have shapes {truth.shape} and {prediction.shape}; both must be the same [..., H, W, C]"
        )
    return truth.astype(jnp.float32), prediction.astype(jnp.float32)


@jax.jit
def psnr(truth: Num[Array, "*B H W C"], prediction: Num[Array, "*B H W C"]) -> Float[Array, "*B"]:
    """Peak signal-to-noise ratio of each frame in dB: 10·log₁₀(255² / MSE), the MSE over pixels and channels.

    The MSE is floored so that the ratio never passes ``PSNR_CAP`` (100 dB), which is what identical frames score.

    Raises:
        ValueError: the shapes differ, or are not [..., H, W, C].
    """
    truth, prediction = _same_frames(truth, prediction)
    mse = jnp.mean((truth - prediction) ** 2, axis=(-3, -2, -1))
    return 10 * jnp.log10(PEAK**2 / jnp.maximum(mse, PEAK**2 * 10 ** (-PSNR_CAP / 10)))


@jax.jit
def ssim(truth: Num[Array, "*B H W C"], prediction: Num[Array, "*B H W C"]) -> Float[Array, "*B"]:
    """Structural similarity of each frame, at most 1 (Wang et al. 2004, Eq. 13).

    Gaussian window 11×11 with σ = 1.5 and unit sum, K₁ = 0.01, K₂ = 0.03, range 255, windows that lie wholly inside
    the frame only (no padding); population (not sample) variances under the window. Each colour channel on its own,
    then the mean over channels and positions.

    Raises:
        ValueError: the shapes differ, are not [..., H, W, C], or a side is shorter than the 11-pixel window.
    """
    truth, prediction = _same_frames(truth, prediction)
    height, width = truth.shape[-3:-1]
    if min(height, width) < _WINDOW:
        raise ValueError(f"SSIM needs frames of at least {_WINDOW}×{_WINDOW} pixels, not {height}×{width}")
    rows, columns = _blur_matrix(height), _blur_matrix(width)

    def blur(x: Array) -> Array:
        # The GPU's default matrix product is too coarse for the small variances that are left over below.
        return jnp.einsum("ih,...hwc,jw->...ijc", rows, x, columns, precision=jax.lax.Precision.HIGHEST)

    mean_x, mean_y = blur(truth), blur(prediction)
    variance_x = blur(truth**2) - mean_x**2
    variance_y = blur(prediction**2) - mean_y**2
    covariance = blur(truth * prediction) - mean_x * mean_y
    c1, c2 = (_K1 * PEAK) ** 2, (_K2 * PEAK) ** 2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    similarity /= (mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2)
    return similarity.mean((-3, -2, -1))


def _blur_matrix(size: int) -> Float[np.ndarray, "size-10 size"]:
    """Row i holds the 1-D Gaussian window over pixels i … i + 10."""
    taps = np.exp(-((np.arange(_WINDOW) - _WINDOW // 2) ** 2) / (2 * _SIGMA**2))
    taps /= taps.sum()
    matrix = np.zeros((size - _WINDOW + 1, size), np.float32)
    for i, row in enumerate(matrix):
        row[i : i + _WINDOW] = taps
    return matrix
