"""Every frame's input also contains the frame before it, so that what stays need not be found by temporal attention.

These tokens are visible in training even where that frame is masked, as past frames are in sampling. No output sees its
own frame this way.

Axes: B clips, T frames, S cells, D code bits.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

Cells = Int[Array, "B T S"] | Float[Array, "B T S D"]


def frame_before(frames: Cells) -> Cells:
    """Returns the frame before each frame; for the first frame, the frame itself."""
    return jnp.concatenate([frames[:, :1], frames[:, :-1]], axis=1)


def absent_cells(branch: str, before: Cells, start: Any, no_depth: Bool[Array, " B"] | None) -> Bool[Array, "B T S"]:
    """Returns the cells without a frame before them: those of a clip's first frame, and all depth of ``no_depth``.

    Args:
        start: position of the first of the frames (may be traced).
    """
    first = (start + jnp.arange(before.shape[1]) == 0)[:, None]
    absent = jnp.broadcast_to(first, before.shape[:3])
    if branch == "depth" and no_depth is not None:
        return absent | no_depth[:, None, None]
    return absent
