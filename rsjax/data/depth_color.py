"""A reversible colour map for depth, so that the RGB tokenizer can read it.

The paper tokenizes depth maps with MAGVIT-2 but does not publish its colour map. Ours goes black → red → yellow →
white: each third of the range raises one channel, so the position along this path is the mean of the three channels.
The inverse is linear, a blurred edge decodes to a depth between its two sides (with a rainbow map it could be any
depth), and 8-bit colours keep 766 levels.
"""

from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32

from rsjax.clip import Array

Scale = Literal["linear", "inverse"]
RELATIVE_FAR = 10.0  # depth of the farthest point of a video whose depth has no unit; the nearest is 1


def depth_to_color(depth: Float[Array, "*batch"], near: float, far: float, scale: Scale) -> Float[Array, "*batch 3"]:
    """Returns depth as colours 0–255 (float32, whole numbers); depth outside [near, far] is clipped to it.

    Args:
        depth: depth in metres, numpy or JAX (so are the colours); 0, which means no depth, becomes black.
        near: depth that becomes white.
        far: depth that becomes black.
        scale: "inverse" spaces levels evenly in 1/depth (finer near the camera), "linear" in depth.
    """
    near_value = _scaled(near, scale)
    far_value = _scaled(far, scale)
    with np.errstate(divide="ignore"):
        position = ((_scaled(depth, scale) - far_value) / (near_value - far_value)).clip(0.0, 1.0) * (depth > 0)
    level = (position * 765.0).round()
    return (level[..., None] - np.array([0.0, 255.0, 510.0], np.float32)).clip(0.0, 255.0)


def color_to_depth(color: Float[Array, "*batch 3"], near: float, far: float, scale: Scale) -> Float[Array, "*batch"]:
    """Inverts :func:`depth_to_color` for any colours 0–255; returns metres in [near, far]."""
    position = color.astype(np.float32).mean(-1) / 255.0
    near_value = _scaled(near, scale)
    far_value = _scaled(far, scale)
    return _scaled(far_value + position * (near_value - far_value), scale)


def stretch(inverse: Float32[np.ndarray, "n H W"], extent: tuple[float, float]) -> Float32[np.ndarray, "n H W"]:
    """Returns relative depth of 1/depth that is known up to a scale and a shift.

    It is 1 at the greatest value of ``extent``, ``RELATIVE_FAR`` at its least, and even in 1/depth beyond them, up to
    1000.
    """
    low, high = extent
    position = (inverse - low) / (high - low) if high > low else np.zeros_like(inverse)
    least = 1 / RELATIVE_FAR
    return (1 / np.maximum(least + (1 - least) * position, 1e-3)).astype(np.float32)


def _scaled(depth: Any, scale: Scale) -> Any:
    return depth if scale == "linear" else 1.0 / depth  # its own inverse
