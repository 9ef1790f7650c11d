"""Frames in which a point is hidden or outside the picture count neither in M_i nor in Eq. 5 and 6.

What lies at a hidden point's place is the surface in front of it, not the point. The paper says nothing of hidden
points.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from rsjax.config import Departures


def counted_frames(departures: Departures, visible: Bool[Array, "B N T"]) -> Bool[Array, "B N T"]:
    """Returns the frames in which each point counts: all, or those that show it with ``visible_keypoints``.

    A point that is not visible in the first frame was not sampled (a clip without tracks has none) and never counts.
    """
    sampled = visible[..., :1]
    if departures.visible_keypoints:
        return visible & sampled
    return jnp.broadcast_to(sampled, visible.shape)
