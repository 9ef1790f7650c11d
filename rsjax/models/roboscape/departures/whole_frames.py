"""Each frame is predicted as a whole, so that training sets every cell the same task as decoding in one pass.

The paper and the public code mask a share of the cells and decode in two passes or more.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool

from rsjax.config import Departures


def hidden(departures: Departures, mask: Bool[Array, "B T *cells"], start: Any = 0) -> Bool[Array, "B T *cells"]:
    """Returns the cells hidden from the network: the masked ones, or with ``whole_frames`` all after a clip's first.

    Args:
        start: position of the first of these frames (may be traced).
    """
    if not departures.whole_frames:
        return mask
    after_first = start + jnp.arange(mask.shape[1]) > 0
    return mask | after_first.reshape(-1, *[1] * (mask.ndim - 2))
