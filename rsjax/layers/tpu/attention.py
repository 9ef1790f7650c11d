"""Attention within frames and over frames as one kernel a pass (Pallas, Mosaic), straight from the qkv projection.

A tile is a frame, or all frames of a few neighbouring cells. A program has the packed queries, keys and values of all
heads of its tile on chip, so that scores, transposes and copies never go to memory. Heads lie side by side along lanes
as the projection wrote them; an array with an axis of 32 channels a head would be padded to 128 lanes in memory, and
moved. Nor are heads cut out of lanes on chip: the product of all 128 lanes of keys with queries whose other lanes are
zero is that of one head, and as fast, since a matrix unit multiplies 128 lanes at once anyway. Scores are (k, q), so
that sums over keys run across registers, and products with them have only the rows of one head's channels.

The gradient recomputes scores from each row's log-sum (FlashAttention-2, Dao 2023, arXiv 2307.08691).

Axes: B clips, T frames, S cells of a frame, h heads, e head width, C = h·e; N tiles of a clip, R tokens of a tile,
q queries, k keys.
"""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jax.experimental import pallas as pl
from jax.experimental.pallas import tpu
from jaxtyping import Array, Float

from rsjax.layers.packed_attention import ATTENTION, HEAD_WIDTHS, Over, Tile, product, scale, sees
from rsjax.layers.partition import each_own_clips

__all__ = ["ATTENTION", "Over", "attend", "fits"]

LANES = 128
MOST_CHANNELS = 1024  # of 256 rows, for the memory on chip
SUBLANES = 8  # rows of a register, which are the cells of a tile over frames


def fits(shape: tuple[int, ...], over: Over) -> bool:
    """Returns whether :func:`attend` takes a qkv of this shape (B, T, S, 3, h, e).

    Head widths are 16, 32, 64 or 128, and h·e is a multiple of 128 and at most 1024. Over cells, S is 128 or 256. Over
    frames, T is 16 or 32 and S is a multiple of 8.
    """
    _, frames, cells, _, heads, width = shape
    channels = heads * width
    if width not in HEAD_WIDTHS or channels % LANES != 0 or channels > MOST_CHANNELS:
        return False
    if over == "cells":
        return cells in (128, 256)
    return frames in (16, 32) and cells % SUBLANES == 0


@partial(jax.custom_vjp, nondiff_argnums=(1, 2))
def attend(qkv: Float[Array, "B T S 3 h e"], over: Over, interpret: bool = False) -> Float[Array, "B T S h e"]:
    """Returns softmax(q·kᵀ/√e)·v among the cells of each frame, or of each cell over the frames up to its own.

    Products have operands of qkv's type; scores, softmax and sums are float32.

    Args:
        qkv: a shape that :func:`fits`, which should be a view of an array (B, T, S, 3·h·e); bfloat16 is fast.
        over: "cells": every cell attends to all cells of its frame; "frames": causally to the same cell.
        interpret: runs without a TPU, slowly.
    """
    return _forward(qkv, over, interpret)[0]


def _forward(qkv: Array, over: Over, interpret: bool) -> tuple[Array, tuple[Array, Array, Array]]:
    *tokens, _, heads, width = qkv.shape
    packed = qkv.reshape(*tokens, -1)
    out, log_sum = (checkpoint_name(x, ATTENTION) for x in _run_forward(over, width, interpret, packed))
    return out.reshape(*tokens, heads, width), (packed, out, log_sum)


def _backward(
    over: Over, interpret: bool, saved: tuple[Array, Array, Array], cotangent: Float[Array, "B T S h e"]
) -> tuple[Float[Array, "B T S 3 h e"]]:
    packed, out, log_sum = saved
    *tokens, heads, width = cotangent.shape
    own = cotangent.reshape(out.shape).astype(out.dtype)
    return (_run_backward(over, width, interpret, packed, out, own, log_sum).reshape(*tokens, 3, heads, width),)


@partial(each_own_clips, settings=3)
def _run_forward(
    over: Over, width: int, interpret: bool, qkv: Float[Array, "B T S 3*C"]
) -> tuple[Float[Array, "B T S C"], Float[Array, "B N h R"]]:
    """Returns the output and the log-sum of each row of scores, to the base 2."""
    tile = _tile(qkv.shape, over)
    clips, frames, cells, _ = qkv.shape
    out = jax.ShapeDtypeStruct((clips, frames, cells, qkv.shape[-1] // 3), qkv.dtype)
    tiles = frames * cells // tile.rows
    log_sum = jax.ShapeDtypeStruct((clips, tiles, out.shape[-1] // width, tile.rows), jnp.float32)
    return tuple(
        pl.pallas_call(
            partial(_forward_kernel, tile=tile, width=width),
            grid=(clips, tiles),
            in_specs=[_tokens(qkv.shape, tile)],
            out_specs=[_tokens(out.shape, tile), _log_sums(log_sum.shape)],
            out_shape=[out, log_sum],
            compiler_params=tpu.CompilerParams(dimension_semantics=("parallel", "parallel")),
            interpret=interpret,
            name=f"attend_{over}_forward",
        )(qkv)
    )


@partial(each_own_clips, settings=3)
def _run_backward(
    over: Over,
    width: int,
    interpret: bool,
    qkv: Float[Array, "B T S 3*C"],
    out: Float[Array, "B T S C"],
    cotangent: Float[Array, "B T S C"],
    log_sum: Float[Array, "B N h R"],
) -> Float[Array, "B T S 3*C"]:
    tile = _tile(qkv.shape, over)
    like_qkv = _tokens(qkv.shape, tile)
    like_out = _tokens(out.shape, tile)
    return pl.pallas_call(
        partial(_backward_kernel, tile=tile, width=width),
        grid=log_sum.shape[:2],
        in_specs=[like_qkv, like_out, like_out, _log_sums(log_sum.shape)],
        out_specs=like_qkv,
        out_shape=jax.ShapeDtypeStruct(qkv.shape, qkv.dtype),
        compiler_params=tpu.CompilerParams(dimension_semantics=("parallel", "parallel")),
        interpret=interpret,
        name=f"attend_{over}_backward",
    )(qkv, out, cotangent, log_sum)


attend.defvjp(_forward, _backward)


def _tile(shape: tuple[int, ...], over: Over) -> Tile:
    if over == "cells":
        return Tile(1, shape[2])
    return Tile(shape[1], SUBLANES)


def _tokens(shape: tuple[int, ...], tile: Tile) -> pl.BlockSpec:
    """Returns the block of one tile of an array (B, T, S, channels)."""
    if tile.frames == 1:
        return pl.BlockSpec((None, 1, *shape[2:]), lambda clip, n: (clip, n, 0, 0))
    return pl.BlockSpec((None, *tile, shape[3]), lambda clip, n: (clip, 0, n, 0))


def _log_sums(shape: tuple[int, ...]) -> pl.BlockSpec:
    """Returns the block of one tile of an array (B, N, h, R)."""
    return pl.BlockSpec((None, None, *shape[2:]), lambda clip, n: (clip, n, 0, 0))


def _forward_kernel(qkv: Any, out: Any, log_sum: Any, *, tile: Tile, width: int) -> None:
    channels = out.shape[-1]
    heads = LANES // width  # side by side in a register
    lane = jax.lax.broadcasted_iota(jnp.int32, (tile.rows, LANES), 1)

    def step(group: Any, _: None) -> None:
        q, k, v = (_rows(qkv, tile, part * channels + group * LANES) for part in range(3))
        v_t = v.T
        own = [(lane >= first) & (lane < first + width) for first in range(0, LANES, width)]
        # Stage by stage, since the compiler does not move one head's products beside another's exponentials.
        scores = [product(k, jnp.where(mask, q, 0), 1, 1) * scale(width) for mask in own]
        if tile.frames > 1:
            scores = [jnp.where(_sees(tile), x, jnp.finfo(jnp.float32).min) for x in scores]
        outs_t = []
        for i, x in enumerate(scores):
            top = jnp.max(x, axis=0, keepdims=True)
            weights = jnp.exp2(x - top)
            total = jnp.sum(weights, axis=0, keepdims=True)
            of_head = slice(i * width, (i + 1) * width)
            outs_t.append(product(v_t[of_head], weights.astype(v.dtype), 1, 0) / total)
            log_sum[pl.ds(group * heads + i, 1)] = top + jnp.log2(total)
        _put_transposed(out, tile, group * LANES, outs_t)

    jax.lax.fori_loop(0, channels // LANES, step, None)


def _backward_kernel(
    qkv: Any, out: Any, cotangent: Any, log_sum: Any, gradient: Any, *, tile: Tile, width: int
) -> None:
    channels = out.shape[-1]
    heads = LANES // width
    lane = jax.lax.broadcasted_iota(jnp.int32, (tile.rows, LANES), 1)

    def step(group: Any, _: None) -> None:
        q, k, v = (_rows(qkv, tile, part * channels + group * LANES) for part in range(3))
        g = _rows(cotangent, tile, group * LANES)
        q_t, k_t, g_t = (x.T for x in (q, k, g))
        along = (g.astype(jnp.float32) * _rows(out, tile, group * LANES).astype(jnp.float32)).T
        gradients_t: tuple[list[Array], ...] = ([], [], [])
        own = [(lane >= first) & (lane < first + width) for first in range(0, LANES, width)]
        scores = [product(k, jnp.where(mask, q, 0), 1, 1) * scale(width) for mask in own]
        of_weights = [product(v, jnp.where(mask, g, 0), 1, 1) for mask in own]
        for i in range(heads):
            of_head = slice(i * width, (i + 1) * width)
            weights = jnp.exp2(scores[i] - log_sum[pl.ds(group * heads + i, 1)])
            if tile.frames > 1:
                weights = jnp.where(_sees(tile), weights, 0.0)
            of_scores = weights * (of_weights[i] - jnp.sum(along[of_head], axis=0, keepdims=True))
            of_scores = of_scores.astype(q.dtype)
            gradients_t[0].append(product(k_t[of_head], of_scores, 1, 0) / math.sqrt(width))
            gradients_t[1].append(product(q_t[of_head], of_scores, 1, 1) / math.sqrt(width))
            gradients_t[2].append(product(g_t[of_head], weights.astype(g.dtype), 1, 1))
        for part, heads_t in enumerate(gradients_t):
            _put_transposed(gradient, tile, part * channels + group * LANES, heads_t)

    jax.lax.fori_loop(0, channels // LANES, step, None)


def _rows(tokens: Any, tile: Tile, first: Any) -> Float[Array, "R 128"]:
    """Loads 128 channels of a tile; rows are (frame, cell)."""
    x = tokens[:, :, pl.ds(pl.multiple_of(first, LANES), LANES)]
    if tile.frames == 1:
        return x[0]
    return x.astype(jnp.float32).reshape(tile.rows, LANES).astype(x.dtype)  # only float32 fills a register in 8 rows


def _put_transposed(tokens: Any, tile: Tile, first: Any, heads: list[Float[Array, "e R"]]) -> None:
    """Stores 128 channels of a tile where :func:`_rows` loads them."""
    x = jnp.concatenate(heads, axis=0).T
    tokens[:, :, pl.ds(pl.multiple_of(first, LANES), LANES)] = x.reshape(*tile, LANES).astype(tokens.dtype)


def _sees(tile: Tile) -> Array:
    """Returns the pairs, (k, q), of a query and a key of the same cell and no later frame."""
    rows = (tile.rows, tile.rows)
    return sees(tile, jax.lax.broadcasted_iota(jnp.int32, rows, 1), jax.lax.broadcasted_iota(jnp.int32, rows, 0))
