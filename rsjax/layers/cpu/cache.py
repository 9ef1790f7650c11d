"""Writes frames into the caches of clips at positions of their own, in place.

Axes: N clips, T frames; a clip's own axes are those of :func:`rsjax.layers.attention.put_frames`.
"""

from typing import Any

import jax
from jaxtyping import Array, Float, Int


def put_clip_by_clip(
    old: Float[Array, "N ..."], fresh: Float[Array, "N ..."], start: Int[Array, " N"], ring: bool
) -> Float[Array, "N ..."]:
    """Returns :func:`rsjax.layers.attention.put_frames` of each clip.

    Mapped over clips it would be a scatter, for which XLA's CPU backend transposes and copies the whole cache.
    """
    frames = fresh.shape[-2]
    slots = old.shape[-2]
    width = 1 if ring else frames  # of a write: frame by frame, since the slots may wrap around
    for clip in range(len(old)):
        for i in range(0, frames, width):
            slot = start[clip] + i
            if ring:
                slot = slot % slots
            place: Any = [clip, *[0] * (old.ndim - 3), slot, 0]
            old = jax.lax.dynamic_update_slice(old, fresh[clip : clip + 1, ..., i : i + width, :], place)
    return old
