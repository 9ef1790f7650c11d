"""Temporal queries and keys are rotated by their position, so that a rollout can go on beyond the trained frames.

The public code learns an embedding for each frame; positions within a frame are learned in both cases.
"""

from jaxtyping import Array, Float, Int

from rsjax.config import Departures
from rsjax.layers.attention import packed, rotate, unpacked


def rotated(
    departures: Departures, qkv: Float[Array, "B T S 3 h e"], positions: Int[Array, " T"]
) -> Float[Array, "B T S 3 h e"]:
    """Rotates temporal queries and keys by the positions of their frames if ``rotary`` is on."""
    if not departures.rotary:
        return qkv
    q, k, v = unpacked(qkv)
    return packed(rotate(q, positions), rotate(k, positions), v)
