"""Eq. 5 compares masked cells only: a third to half of ŝ_t lie on visible cells, which are never sampled.

It had no effect in the measurements of notebooks/keypoints.md.

Axes: B clips, T frames, H×W cells, K keypoints.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from rsjax.config import Departures


def compared(departures: Departures, mask: Bool[Array, "B T H W"], cells: Int[Array, "B T K"]) -> Bool[Array, "B T K"]:
    """Returns whether Eq. 5 compares each keypoint in each frame: always, or on masked cells with this departure."""
    if not departures.masked_keypoints:
        return jnp.ones(cells.shape, bool)
    return jnp.take_along_axis(mask.reshape(*mask.shape[:2], -1), cells, axis=2)
