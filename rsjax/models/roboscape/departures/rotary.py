"""Temporal queries and keys are rotated by their position, so that a rollout can go on beyond the trained frames.

The public code learns an embedding for each frame; positions within a frame are learned in both cases.
"""

from jaxtyping import Array, Float, Int

from rsjax.config import Departures
from rsjax.layers.attention import rotate


def rotated(
    departures: Departures, x: Float[Array, "B T S h e"], positions: Int[Array, " T"]
) -> Float[Array, "B T S h e"]:
    """Returns temporal queries or keys, rotated by the positions of their frames if ``rotary`` is on."""
    if not departures.rotary:
        return x
    return rotate(x, positions)
