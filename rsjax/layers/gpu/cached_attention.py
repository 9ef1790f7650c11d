"""Attention of a rollout's newest frames over the temporal cache as one kernel (Pallas, Triton), without a gradient.

A query has as few keys as the cache has slots, so that its time is that of reading the cache once. Therefore products
are sums of a program's own elements, without matrix units.

Axes: B clips, F new frames, S cells of a frame, h heads, e head width, N slots of the cache; s cells and r heads of a
program.
"""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Float, Int

from rsjax.layers.packed_attention import HEAD_WIDTHS, scale
from rsjax.layers.partition import each_own_clips

NEW_FRAMES = (1, 2)  # of a pass
ELEMENTS = 4096  # of a program's keys, as many as its values; both are in registers
WARPS = 4


def fits(qkv: tuple[int, ...], slots: int) -> bool:
    """Returns whether :func:`attend` takes a qkv of this shape (B, F, S, 3, h, e) and a cache of this many slots.

    F is 1 or 2, head widths are 16, 32, 64 or 128, and slots are a power of two up to 4096/e.
    """
    _, frames, _, _, _, width = qkv
    is_power = slots & (slots - 1) == 0
    return frames in NEW_FRAMES and width in HEAD_WIDTHS and is_power and slots * width <= ELEMENTS


def attend(
    qkv: Float[Array, "B F S 3 h e"],
    keys: Float[Array, "B S h N e"],
    values: Float[Array, "B S h N e"],
    start: Int[Array, ""] | int,
    window: int,
    interpret: bool = False,
) -> Float[Array, "B F S h e"]:
    """Returns softmax(q·kᵀ/√e)·v of each cell over itself in the frames of the cache and the new ones up to its own.

    Scores, softmax and sums are float32.

    Args:
        qkv: of the new frames; a shape that :func:`fits`.
        keys: of earlier frames, frame f in slot f mod N.
        start: the first new frame's position. Keys of this and later frames are not read from the cache.
        window: the number of frames that a query sees, its own included.
        interpret: runs without a GPU, slowly.
    """
    _, frames, cells, _, heads, width = qkv.shape
    slots = keys.shape[-2]
    own_heads = math.gcd(heads, ELEMENTS // (slots * width))
    own_cells = math.gcd(cells, ELEMENTS // (slots * width * own_heads))
    cached = pl.BlockSpec((None, own_cells, own_heads, slots, width), lambda cell, head, clip: (clip, cell, head, 0, 0))

    @partial(each_own_clips, settings=0)
    def run(qkv: Array, keys: Array, values: Array, starts: Array) -> tuple[Array]:
        out: Array = pl.pallas_call(
            partial(_kernel, window=window),
            grid=(cells // own_cells, heads // own_heads, len(qkv)),
            in_specs=[
                pl.BlockSpec(
                    (None, frames, own_cells, 3, own_heads, width), lambda cell, head, clip: (clip, 0, cell, 0, head, 0)
                ),
                cached,
                cached,
                pl.BlockSpec((None,), lambda cell, head, clip: (clip,)),
            ],
            out_specs=pl.BlockSpec(
                (None, frames, own_cells, own_heads, width), lambda cell, head, clip: (clip, 0, cell, head, 0)
            ),
            out_shape=jax.ShapeDtypeStruct((len(qkv), frames, cells, heads, width), qkv.dtype),
            compiler_params=triton.CompilerParams(num_warps=WARPS),
            interpret=interpret,
            name="attend_cache",
        )(qkv, keys, values, starts)
        return (out,)

    starts = jnp.broadcast_to(jnp.asarray(start, jnp.int32), len(qkv))
    with jax.named_scope("attend_cache"):  # a compiler that divides the kernel among devices forgets its name
        out: Array = run(qkv, keys, values, starts)[0]
    return out


def _kernel(qkv: Any, keys: Any, values: Any, start: Any, out: Any, *, window: int) -> None:
    k, v = (x[...].astype(jnp.float32) for x in (keys, values))
    slots, width = k.shape[-2:]
    first = start[...]
    slot = jnp.arange(slots)
    in_slot = first - 1 - ((first - 1 - slot) & (slots - 1))  # the newest frame before the first in each slot
    lowest = jnp.finfo(jnp.float32).min
    for query in range(out.shape[0]):
        q = qkv[query, :, 0].astype(jnp.float32) * scale(width)
        new = range(max(0, query - window + 1), query + 1)
        seen = (in_slot >= 0) & (first + query - in_slot < window)
        scores = jnp.where(seen, jnp.sum(q[:, :, None] * k, axis=-1), lowest)
        new_scores = [jnp.sum(q * qkv[key, :, 1].astype(jnp.float32), axis=-1) for key in new]
        top = jnp.max(scores, axis=-1)
        for one in new_scores:
            top = jnp.maximum(top, one)
        weights = jnp.exp2(scores - top[:, :, None])
        total = jnp.sum(weights, axis=-1)
        weighted = jnp.sum(weights[..., None] * v, axis=2)
        for key, one in zip(new, new_scores, strict=True):
            weight = jnp.exp2(one - top)
            total += weight
            weighted += weight[..., None] * qkv[key, :, 2].astype(jnp.float32)
        out[query] = (weighted / total[..., None]).astype(out.dtype)
