"""Which frames a frame is decoded from.

With rotary positions it is the ``model.frames - 1`` before it, and the window moves on with every frame. Learned
positions are numbered from the window's first frame, so what was computed of a frame holds only while the window stays:
it jumps by a stride, and the frames that it keeps are encoded anew.

Axes: B clips, T frames, A action dimensions.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from rsjax.clip import Array
from rsjax.config import ModelConfig, SampleConfig


def stride(model: ModelConfig, sample: SampleConfig) -> int:
    """Frames by which a full window moves on (learned positions)."""
    return sample.window_stride or model.frames // 2


def window_start(model: ModelConfig, sample: SampleConfig, frame: Int[Array, ""] | int) -> Int[Array, ""] | int:
    """The first frame of the window that ``frame`` is decoded in: 0, until ``model.frames`` frames are full."""
    if model.positions == "rotary":
        return 0
    by, excess = stride(model, sample), frame + 1 - model.frames
    return (excess + by - 1) // by * by * (excess > 0)


def room(model: ModelConfig, sample: SampleConfig, frames: int) -> int:
    """Frames that the arrays of a rollout of ``frames`` frames hold: few sizes, and every window within.

    A multiple of ``model.frames``, so that up to there all lengths share one compiled program.
    """
    whole = -(-frames // model.frames) * model.frames
    return whole + stride(model, sample) if model.positions == "learned" and whole > model.frames else whole


def cache_slots(model: ModelConfig, given: int) -> int:
    """Slots of the temporal cache of a rollout with ``given`` prompt frames.

    The pass over frames (t-1, t) is what needs most: frame t-1 still attends to t - ``model.frames``, so a rolling
    cache has one slot more than the window. A longer prompt is encoded in one pass, which must find room.
    """
    return model.frames if model.positions == "learned" else max(model.frames + 1, given - 1)


def window_actions(
    model: ModelConfig,
    actions: Float[Array, "B T A"],
    base: Int[Array, ""] | int,
    start: Int[Array, ""] | int,
    length: int,
) -> Float[Array, "B length A"]:
    """The actions into frames start … start + length - 1, as they would be in a clip that begins with frame ``base``.

    A clip's first frame has no action, and the sums of ``model.integrate_actions`` begin with it.
    """
    rows = jax.lax.dynamic_slice_in_dim(actions, start, length, axis=1)
    moved = rows
    if model.integrate_actions:
        before = jax.lax.dynamic_slice_in_dim(actions, base, 1, axis=1)
        is_sum = jnp.arange(actions.shape[-1]) >= actions.shape[-1] // 2
        moved = rows - jnp.where(is_sum, before, 0.0)
    first = (start + jnp.arange(length) == base)[None, :, None]
    return jnp.where(base > 0, jnp.where(first, 0.0, moved), rows)
