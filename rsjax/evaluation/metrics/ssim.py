"""SSIM of frames with values 0–255 (uint8, or floats on the same scale)."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num

from rsjax.clip import Array
from rsjax.evaluation.metrics.psnr import PEAK, same_frames
from rsjax.evaluation.registry import PerClip, PerFrame, Scene, Unavailable, metric

_WINDOW = 11
_SIGMA = 1.5
_K1 = 0.01
_K2 = 0.03


def per_frame(scene: Scene) -> PerFrame:
    """Scores every predicted frame.

    Raises:
        Unavailable: the frames are smaller than the window.
    """
    side = min(scene.truth.rgb.shape[2:4])
    if side < _WINDOW:
        raise Unavailable(f"frames of {side} pixels; SSIM takes windows of {_WINDOW}")
    first = scene.prompt_frames
    # Clip by clip: of 1,200 clips of 256² pixels together, the blurred pictures take 97 GiB.
    clips = zip(scene.truth.rgb[:, first:], scene.prediction.rgb[:, first:], strict=True)
    return np.stack([np.asarray(ssim(truth, prediction)) for truth, prediction in clips])


@metric("ssim", "SSIM", better="higher", decimals=3, per_frame=per_frame)
def score(scene: Scene) -> PerClip:
    """Returns the mean over each clip's predicted frames."""
    return scene.shared(per_frame).mean(-1)


@jax.jit
def ssim(truth: Num[Array, "*B H W C"], prediction: Num[Array, "*B H W C"]) -> Float[Array, "*B"]:
    """Returns the structural similarity of each frame, at most 1 (Wang et al. 2004, Eq. 13).

    Gaussian window 11×11 with σ = 1.5 and unit sum, K₁ = 0.01, K₂ = 0.03, range 255, no padding; population (not
    sample) variances under the window. The result is the mean over channels and positions.

    Raises:
        ValueError: the shapes differ, are not [..., H, W, C], or a side is shorter than the 11-pixel window.
    """
    truth, prediction = same_frames(truth, prediction)
    height, width = truth.shape[-3:-1]
    if min(height, width) < _WINDOW:
        raise ValueError(f"SSIM needs frames of at least {_WINDOW}×{_WINDOW} pixels, not {height}×{width}")
    rows = _blur_matrix(height)
    columns = _blur_matrix(width)

    def blur(x: Array) -> Array:
        # The GPU's default precision is too low: the variances are small differences of large numbers.
        return jnp.einsum("ih,...hwc,jw->...ijc", rows, x, columns, precision=jax.lax.Precision.HIGHEST)

    mean_x = blur(truth)
    mean_y = blur(prediction)
    variance_x = blur(truth**2) - mean_x**2
    variance_y = blur(prediction**2) - mean_y**2
    covariance = blur(truth * prediction) - mean_x * mean_y
    c1 = (_K1 * PEAK) ** 2
    c2 = (_K2 * PEAK) ** 2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    similarity /= (mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2)
    return similarity.mean((-3, -2, -1))


def _blur_matrix(size: int) -> Float[np.ndarray, "size-10 size"]:
    """Returns a matrix whose row i is the 1-D Gaussian window over pixels i … i + 10."""
    taps = np.exp(-((np.arange(_WINDOW) - _WINDOW // 2) ** 2) / (2 * _SIGMA**2))
    taps /= taps.sum()
    matrix = np.zeros((size - _WINDOW + 1, size), np.float32)
    for i, row in enumerate(matrix):
        row[i : i + _WINDOW] = taps
    return matrix
