"""Keeps what stands still: where little changes, a generated frame shows the prompt's last frame as it was recorded.

Few tokens a frame blur a scene, and under a fixed camera most of the blur lies where the prompt shows the truth. With
the prompt's last frame x₀, its reconstruction y₀ and a decoded frame y, the video shows

    x = x₀ + w·(y - x₀),  w = c² / (c² + σ²),

pixel by pixel, where c is the mean of |y - y₀| over the colours, blurred by a Gaussian. If y errs by σ, and x₀ by c
because the scene has changed since, and the errors are independent, this w has the least expected squared error. c
compares two reconstructions, so their common blur does not count as a change. The network never reads x.
"""

import cv2
import numpy as np
from jaxtyping import UInt8

from rsjax.config import KeepStillConfig


def keep_still(
    settings: KeepStillConfig,
    token: int,
    frames: UInt8[np.ndarray, "*B T H W 3"],
    recorded: UInt8[np.ndarray, "*B H W 3"],
    decoded: UInt8[np.ndarray, "*B H W 3"],
) -> UInt8[np.ndarray, "*B T H W 3"]:
    """Returns decoded frames with what stands still from the prompt's last frame; that frame itself returns exactly.

    Args:
        token: side of a token in pixels, in which the blur is measured.
        recorded, decoded: the prompt's last frame and its reconstruction, of each clip or of one for all.
    """
    start = recorded[..., None, :, :, :].astype(np.float32)
    made = frames.astype(np.float32)
    change = np.abs(made - decoded[..., None, :, :, :]).mean(-1)
    if settings.blur:
        flat = change.reshape(-1, *change.shape[-2:])
        flat = np.stack([cv2.GaussianBlur(each, (0, 0), settings.blur * token) for each in flat])
        change = flat.reshape(change.shape)
    weight = change**2 / (change**2 + settings.noise**2)
    return np.round(start + weight[..., None] * (made - start)).astype(np.uint8)
