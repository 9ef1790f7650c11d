"""The window of frames that a frame is decoded from.

With rotary positions the window contains the ``arch.frames - 1`` frames before that frame, and moves with every frame.
Learned positions count from the window's first frame, so the cache is valid only while the window stays in place. The
window therefore moves by a stride, and the frames that stay in it are encoded again.

Axes: B clips, T frames, A action dimensions.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from rsjax.clip import Array
from rsjax.config import SampleConfig
from rsjax.models.roboscape.architecture import Architecture


def stride(arch: Architecture, sample: SampleConfig) -> int:
    """Returns the number of frames by which a full window moves (learned positions)."""
    return sample.window_stride or arch.frames // 2


def window_start(arch: Architecture, sample: SampleConfig, frame: Int[Array, ""] | int) -> Int[Array, ""] | int:
    """Returns the first frame of the window that ``frame`` is decoded in: 0 for the first ``arch.frames`` frames."""
    if arch.departures.rotary:
        return 0
    by, excess = stride(arch, sample), frame + 1 - arch.frames
    return (excess + by - 1) // by * by * (excess > 0)


def room(arch: Architecture, sample: SampleConfig, frames: int) -> int:
    """Returns the length of the arrays of a rollout of ``frames`` frames, so that every window fits into them.

    The length is rounded up to a multiple of ``arch.frames`` (plus a stride), so that few programs are compiled.
    """
    whole = -(-frames // arch.frames) * arch.frames
    return whole + stride(arch, sample) if not arch.departures.rotary and whole > arch.frames else whole


def cache_slots(arch: Architecture, past: int) -> int:
    """Returns the number of slots of the temporal cache of a rollout with ``past`` prompt frames.

    In the pass over frames (t-1, t), frame t-1 still attends to t - ``arch.frames``, so a rolling cache has one slot
    more than the window. A longer prompt is encoded in one pass and must fit.
    """
    return arch.frames if not arch.departures.rotary else max(arch.frames + 1, past - arch.uncommitted)


def window_actions(
    arch: Architecture,
    actions: Float[Array, "B T A"],
    base: Int[Array, ""] | int,
    start: Int[Array, ""] | int,
    length: int,
) -> Float[Array, "B length A"]:
    """Returns the actions into frames start … start + length - 1, as in a clip that begins with frame ``base``.

    The first frame of a clip has no action, and the sums of ``model.departures.integrate_actions`` start there.
    """
    rows = jax.lax.dynamic_slice_in_dim(actions, start, length, axis=1)
    moved = rows
    if arch.departures.integrate_actions:
        before = jax.lax.dynamic_slice_in_dim(actions, base, 1, axis=1)
        is_sum = jnp.arange(actions.shape[-1]) >= actions.shape[-1] // 2
        moved = rows - jnp.where(is_sum, before, 0.0)
    first = (start + jnp.arange(length) == base)[None, :, None]
    return jnp.where(base > 0, jnp.where(first, 0.0, moved), rows)
