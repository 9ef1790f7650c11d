"""Attention within frames and over frames as one kernel a pass (Pallas, Triton), straight from the qkv projection.

A tile of tokens of one head fits on a GPU's multiprocessor: all cells of a frame, or all frames of a few neighbouring
cells. A program loads the queries, keys and values of its tile from where the projection wrote them, so that scores,
transposes and copies never go to memory. The gradient recomputes scores from each row's log-sum (FlashAttention-2, Dao
2023, arXiv 2307.08691); since a tile has all keys of its queries, one loop over queries suffices for it.

Axes: B clips, T frames, S cells of a frame, h heads, e head width; N tiles, R tokens of a tile, q queries, k keys.
"""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Float

from rsjax.layers.packed_attention import ATTENTION, HEAD_WIDTHS, Over, Tile, product, scale, sees
from rsjax.layers.partition import each_own_clips

__all__ = ["ATTENTION", "Over", "attend", "fits"]

ROWS = 64  # tokens of a tile over frames
QUERIES = 128  # of a program of the forward pass
KEYS = 64  # of one step of the forward pass
QUERIES_BACKWARD = 32  # of one step of the backward pass
WARPS = 4
WARPS_BACKWARD = 8
STAGES = 2  # steps of a loop whose operands are in flight
LARGE_TILE = 2**14  # one whose keys and values leave no room for the next step's queries on an RTX 4090


def fits(shape: tuple[int, ...], over: Over) -> bool:
    """Returns whether :func:`attend` takes a qkv of this shape (B, T, S, 3, h, e).

    Head widths are 16, 32, 64 or, over frames, 128. Over cells, S is a power of two from 16 to 256. Over frames, T is a
    power of two from 2 to 64, and S is divisible by the 64/T neighbouring cells of a tile.
    """
    _, frames, cells, _, _, width = shape
    if width not in HEAD_WIDTHS:
        return False
    if over == "cells":
        return cells in (16, 32, 64, 128, 256) and width <= 64
    return frames in (2, 4, 8, 16, 32, 64) and cells % (ROWS // frames) == 0


@partial(jax.custom_vjp, nondiff_argnums=(1, 2))
def attend(qkv: Float[Array, "B T S 3 h e"], over: Over, interpret: bool = False) -> Float[Array, "B T S h e"]:
    """Returns softmax(q·kᵀ/√e)·v among the cells of each frame, or of each cell over the frames up to its own.

    Products have operands of qkv's type; scores, softmax and sums are float32.

    Args:
        qkv: a shape that :func:`fits`; bfloat16 is fast, float32 is exact.
        over: "cells": every cell attends to all cells of its frame; "frames": causally to the same cell.
        interpret: runs without a GPU, slowly.
    """
    return _forward(qkv, over, interpret)[0]


def _forward(qkv: Array, over: Over, interpret: bool) -> tuple[Array, tuple[Array, Array, Array]]:
    with jax.named_scope(f"attend_{over}_forward"):  # a compiler that divides the kernel among devices forgets its name
        out, log_sum = (checkpoint_name(x, ATTENTION) for x in _run_forward(over, interpret, qkv))
    return out, (qkv, out, log_sum)


def _backward(
    over: Over, interpret: bool, saved: tuple[Array, Array, Array], cotangent: Array
) -> tuple[Float[Array, "B T S 3 h e"]]:
    qkv, out, log_sum = saved
    with jax.named_scope(f"attend_{over}_backward"):
        return (_run_backward(over, interpret, qkv, out, cotangent.astype(qkv.dtype), log_sum),)


@partial(each_own_clips, settings=2)
def _run_forward(
    over: Over, interpret: bool, qkv: Float[Array, "B T S 3 h e"]
) -> tuple[Float[Array, "B T S h e"], Float[Array, "B N h R"]]:
    """Returns the output and the log-sum of each row of scores, to the base 2."""
    tile = _tile(qkv.shape, over)
    queries = _step(tile, QUERIES)
    clips, frames, cells, _, heads, width = qkv.shape
    tiles = frames * cells // tile.rows
    out_shape = (clips, frames, cells, heads, width)
    log_sum_shape = (clips, tiles, heads, tile.rows)
    return tuple(
        pl.pallas_call(
            partial(_forward_kernel, tile=tile, queries=queries, keys=_step(tile, KEYS)),
            grid=(tile.rows // queries, heads, clips * tiles),
            in_specs=[_tokens(qkv.shape, tile)],
            out_specs=[_tokens(out_shape, tile), _log_sums(log_sum_shape)],
            out_shape=[
                jax.ShapeDtypeStruct(out_shape, qkv.dtype),
                jax.ShapeDtypeStruct(log_sum_shape, jnp.float32),
            ],
            compiler_params=triton.CompilerParams(num_warps=WARPS, num_stages=STAGES),
            interpret=interpret,
            name=f"attend_{over}_forward",
        )(qkv)
    )


@partial(each_own_clips, settings=2)
def _run_backward(
    over: Over,
    interpret: bool,
    qkv: Float[Array, "B T S 3 h e"],
    out: Float[Array, "B T S h e"],
    cotangent: Float[Array, "B T S h e"],
    log_sum: Float[Array, "B N h R"],
) -> Float[Array, "B T S 3 h e"]:
    tile = _tile(qkv.shape, over)
    clips, tiles, heads, _ = log_sum.shape
    like_qkv = _tokens(qkv.shape, tile)
    like_out = _tokens(out.shape, tile)
    warps = WARPS
    if tile.rows > ROWS:
        warps = WARPS_BACKWARD
    stages = STAGES
    if tile.rows * qkv.shape[-1] >= LARGE_TILE:
        stages = 1
    return pl.pallas_call(
        partial(_backward_kernel, tile=tile, queries=_step(tile, QUERIES_BACKWARD)),
        grid=(1, heads, clips * tiles),
        in_specs=[like_qkv, like_out, like_out, _log_sums(log_sum.shape)],
        out_specs=like_qkv,
        out_shape=jax.ShapeDtypeStruct(qkv.shape, qkv.dtype),
        compiler_params=triton.CompilerParams(num_warps=warps, num_stages=stages),
        interpret=interpret,
        name=f"attend_{over}_backward",
    )(qkv, out, cotangent, log_sum)


attend.defvjp(_forward, _backward)


def _tile(shape: tuple[int, ...], over: Over) -> Tile:
    _, frames, cells, _, _, _ = shape
    if over == "cells":
        return Tile(1, cells)
    return Tile(frames, ROWS // frames)


def _step(tile: Tile, most: int) -> int:
    """Returns the tokens of one step of a loop over a tile: all if it has several frames."""
    return min(most, tile.rows) if tile.frames == 1 else tile.rows


def _tokens(shape: tuple[int, ...], tile: Tile) -> pl.BlockSpec:
    """Returns the block of one tile and head of an array (B, T, S, 3, h, e) or (B, T, S, h, e)."""
    packed = shape[3:-2]
    tiles_of_frame = shape[2] // tile.cells
    tiles_of_clip = shape[1] // tile.frames * tiles_of_frame

    def index(_: Any, head: Any, n: Any) -> tuple[Any, ...]:
        clip = jax.lax.div(n, tiles_of_clip)
        frame = jax.lax.div(jax.lax.rem(n, tiles_of_clip), tiles_of_frame)
        return (clip, frame, jax.lax.rem(n, tiles_of_frame), *(0 for _ in packed), head, 0)

    return pl.BlockSpec((None, tile.frames, tile.cells, *packed, None, shape[-1]), index)


def _log_sums(shape: tuple[int, ...]) -> pl.BlockSpec:
    """Returns the block of one tile and head of an array (B, N, h, R)."""
    _, tiles, _, rows = shape
    return pl.BlockSpec(
        (None, None, None, rows), lambda _, head, n: (jax.lax.div(n, tiles), jax.lax.rem(n, tiles), head, 0)
    )


def _forward_kernel(qkv: Any, out: Any, log_sum: Any, *, tile: Tile, queries: int, keys: int) -> None:
    first = pl.program_id(0) * queries
    q = _rows(qkv, tile, first, queries, 0)
    width = q.shape[-1]

    def step(i: Any, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        total, top, weighted = carry
        k = _rows(qkv, tile, i * keys, keys, 1)
        v = _rows(qkv, tile, i * keys, keys, 2)
        scores = product(q, k, 1, 1) * scale(width)
        if tile.frames > 1:
            seen = sees(tile, first + jnp.arange(queries)[:, None], i * keys + jnp.arange(keys)[None])
            scores = jnp.where(seen, scores, jnp.finfo(jnp.float32).min)
        new_top = jnp.maximum(top, jnp.max(scores, axis=1))
        weights = jnp.exp2(scores - new_top[:, None])
        shrink = jnp.exp2(top - new_top)
        total = total * shrink + jnp.sum(weights, axis=1)
        weighted = weighted * shrink[:, None] + product(weights.astype(v.dtype), v, 1, 0)
        return total, new_top, weighted

    start = (
        jnp.zeros(queries, jnp.float32),
        jnp.full(queries, jnp.finfo(jnp.float32).min),
        jnp.zeros(q.shape, jnp.float32),
    )
    total, top, weighted = jax.lax.fori_loop(0, tile.rows // keys, step, start)
    log_sum[pl.ds(first, queries)] = top + jnp.log2(total)
    _put(out, tile, first, weighted / total[:, None])


def _backward_kernel(
    qkv: Any, out: Any, cotangent: Any, log_sum: Any, gradient: Any, *, tile: Tile, queries: int
) -> None:
    k = _rows(qkv, tile, 0, tile.rows, 1)
    v = _rows(qkv, tile, 0, tile.rows, 2)
    width = k.shape[-1]

    def step(i: Any, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        to_k, to_v = carry
        first = i * queries
        q = _rows(qkv, tile, first, queries, 0)
        g = _rows(cotangent, tile, first, queries)
        along = jnp.sum(g.astype(jnp.float32) * _rows(out, tile, first, queries).astype(jnp.float32), axis=1)
        # Transposed, (k, q): so two products of three take weights and their gradients as they are in registers.
        weights = jnp.exp2(product(k, q, 1, 1) * scale(width) - log_sum[pl.ds(first, queries)][None])
        if tile.frames > 1:
            seen = sees(tile, first + jnp.arange(queries)[None], jnp.arange(tile.rows)[:, None])
            weights = jnp.where(seen, weights, 0.0)
        of_scores = (weights * (product(v, g, 1, 1) - along[None])).astype(q.dtype)
        to_v = to_v + product(weights.astype(g.dtype), g, 1, 0)
        to_k = to_k + product(of_scores, q, 1, 0)
        _put(gradient, tile, first, product(of_scores, k, 0, 0) / math.sqrt(width), 0)
        return to_k, to_v

    zeros = jnp.zeros(k.shape, jnp.float32)
    to_k, to_v = jax.lax.fori_loop(0, tile.rows // queries, step, (zeros, zeros))
    _put(gradient, tile, 0, to_k / math.sqrt(width), 1)
    _put(gradient, tile, 0, to_v, 2)


def _rows(tokens: Any, tile: Tile, first: Any, count: int, *part: int) -> Float[Array, "R e"]:
    """Loads this many tokens of a tile; rows are (frame, cell)."""
    x = tokens[(slice(None), _cells(tile, first, count), *part, slice(None))]
    return x.reshape(count, x.shape[-1])


def _put(tokens: Any, tile: Tile, first: Any, x: Float[Array, "R e"], *part: int) -> None:
    """Stores tokens of a tile where :func:`_rows` loads them."""
    where = (slice(None), _cells(tile, first, len(x)), *part, slice(None))
    tokens[where] = x.reshape(tile.frames, -1, x.shape[-1]).astype(tokens.dtype)


def _cells(tile: Tile, first: Any, count: int) -> Any:
    if tile.frames == 1:
        return pl.ds(first, count)
    return slice(None)
