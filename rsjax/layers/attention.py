"""Multi-head attention within frames and over keys and values in a cache, and rotary positions.

Axes: B clips, T frames, S cells of a frame, L blocks, h heads, e head width, q queries, k keys.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

FEW = 2  # frames per pass of a rollout


@struct.dataclass
class KeyValues:
    """Temporal keys and values of one branch, of one block or stacked over blocks (axis L).

    Frames come after heads, as the products read them; otherwise every pass would transpose the whole cache.
    """

    k: Float[Array, "*L B S h T e"]
    v: Float[Array, "*L B S h T e"]


def attend(
    q: Float[Array, "*N q h e"],
    k: Float[Array, "*N k h e"],
    v: Float[Array, "*N k h e"],
    mask: Bool[Array, "q k"] | None,
) -> Float[Array, "*N q h e"]:
    """Returns softmax(q·kᵀ/√e)·v over the keys that ``mask`` allows; the softmax is float32."""
    scores = jnp.einsum("...qhe,...khe->...hqk", q, k, preferred_element_type=jnp.float32) * q.shape[-1] ** -0.5
    if mask is not None:
        scores = jnp.where(mask, scores, jnp.finfo(jnp.float32).min)
    return jnp.einsum("...hqk,...khe->...qhe", jax.nn.softmax(scores, axis=-1).astype(v.dtype), v)


def packed(
    q: Float[Array, "B T S h e"], k: Float[Array, "B T S h e"], v: Float[Array, "B T S h e"]
) -> Float[Array, "B T S 3 h e"]:
    """Puts queries, keys and values side by side, as their projection returns them."""
    return jnp.stack([q, k.astype(q.dtype), v.astype(q.dtype)], axis=-3)


def unpacked(qkv: Float[Array, "B T S 3 h e"]) -> tuple[Float[Array, "B T S h e"], ...]:
    """Returns queries, keys and values of their projection."""
    return tuple(qkv[..., i, :, :] for i in range(3))


def attend_parts(
    q: Float[Array, "*N q e"], parts: Sequence[tuple[KeyValues, Bool[Array, "q k"]]]
) -> Float[Array, "*N q e"]:
    """Returns :func:`attend` over the concatenation of several keys and values, each with its mask."""
    scores = []
    for part, mask in parts:
        product = jnp.einsum("...qe,...ke->...qk", q, part.k, preferred_element_type=jnp.float32) * q.shape[-1] ** -0.5
        scores.append(jnp.where(mask, product, jnp.finfo(jnp.float32).min))
    weights = jax.nn.softmax(jnp.concatenate(scores, axis=-1), axis=-1)
    shares = jnp.split(weights, np.cumsum([x.shape[-1] for x in scores])[:-1], axis=-1)
    outs = [
        jnp.einsum("...qk,...ke->...qe", share.astype(part.v.dtype), part.v)
        for share, (part, _) in zip(shares, parts, strict=True)
    ]
    return sum(outs[1:], start=outs[0])


def attend_few(
    q: Float[Array, "*N q e"], parts: Sequence[tuple[KeyValues, Bool[Array, "q k"]]]
) -> Float[Array, "*N q e"]:
    """Returns :func:`attend_parts`, query by query if there are few, which is three times as fast on a CPU."""
    queries = q.shape[-2]
    if queries > FEW:
        return attend_parts(q, parts)
    outs = []
    for i in range(queries):
        rows = slice(i, i + 1)
        outs.append(attend_parts(q[..., rows, :], [(part, mask[rows]) for part, mask in parts]))
    return jnp.concatenate(outs, axis=-2)


def attend_cached(
    qkv: Float[Array, "B T S 3 h e"], cache: KeyValues, start: Any, window: int
) -> Float[Array, "B T S h e"]:
    """Returns :func:`attend` of each cell over itself in the frames of a cache and the new ones up to its own.

    Args:
        qkv: of frames start … start + T - 1.
        cache: of frames before ``start``, frame f in slot f mod N; later frames in it are not read.
        window: the number of frames that a query sees, its own included.
    """
    positions = start + jnp.arange(qkv.shape[1])
    frame_of_slot = frames_held(cache.k.shape[-2], start - 1)
    q, k, v = (x.transpose(0, 2, 3, 1, 4) for x in unpacked(qkv))  # B S h T e
    parts = [(cache, sees(positions, frame_of_slot, window)), (KeyValues(k, v), sees(positions, positions, window))]
    return attend_few(q, parts).transpose(0, 3, 1, 2, 4).astype(qkv.dtype)


def sees(queries: Int[Array, " q"], keys: Int[Array, " k"], window: int) -> Bool[Array, "q k"]:
    """Returns whether a query sees a key: of its own frame or the ``window - 1`` before it; negative ones are empty."""
    age = queries[:, None] - keys[None, :]
    return (age >= 0) & (age < window) & (keys >= 0)


def rotate(x: Float[Array, "B T S h e"], positions: Int[Array, " T"]) -> Float[Array, "B T S h e"]:
    """Applies rotary position embedding: rotates channels i and i + e/2 by position · 10000^(-2i/e), in float32.

    The product of a rotated query and key depends only on the difference of their positions.
    """
    half = x.shape[-1] // 2
    angles = positions[:, None] * 10_000.0 ** (-jnp.arange(half) / half)
    cos, sin = (f(angles)[:, None, None] for f in (jnp.cos, jnp.sin))
    first, second = jnp.split(x, 2, axis=-1)
    return jnp.concatenate([first * cos - second * sin, second * cos + first * sin], axis=-1).astype(x.dtype)


def frames_held(slots: int, last: Int[Array, ""] | int) -> Int[Array, " slots"]:
    """Returns the frame in each slot of a cache after frame ``last`` is written; negative for empty slots."""
    return last - (last - jnp.arange(slots)) % slots


def put_frames(
    old: Float[Array, "*L B S h N e"], fresh: Float[Array, "*L B S h T e"], start: Any, ring: bool
) -> Float[Array, "*L B S h N e"]:
    """Returns a cache's keys or values with new frames from ``start`` on.

    Args:
        ring: whether positions beyond the number of slots wrap around.
    """
    if not ring:
        return jax.lax.dynamic_update_slice_in_dim(old, fresh, start, axis=-2)
    for i in range(fresh.shape[-2]):  # frame by frame, since the slots may wrap around
        slot = (start + i) % old.shape[-2]
        old = jax.lax.dynamic_update_slice_in_dim(old, fresh[..., i : i + 1, :], slot, axis=-2)
    return old
