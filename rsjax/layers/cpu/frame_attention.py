"""Attention within frames, or within other sequences, with bf16 products and a hand-written gradient.

A frame's scores are the largest arrays of a training step. They are not kept: the gradient recomputes them from
queries, keys and each row's log-sum. Both passes treat frames one by one, so that a frame's scores stay in the
processor's cache, and unroll the loop over them, so that XLA runs several frames at the same time. Every product
contracts the last axis of its first operand, the only form for which XLA's CPU backend has fast bf16 kernels. So the
gradients of keys and values transpose their small operands in memory, never the scores. A CPU without bf16 units
multiplies in float32 instead, without these copies.

Axes: N frames (or sequences), S cells (q of the queries, k of the keys), h heads, e head width.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax import runtime
from rsjax.layers.cpu.matmul import transposed_in_memory

# From this many cells of a frame, or tokens of a sequence, bf16 products in attention save more time than their
# transposes cost.
LARGE_FRAME = 128
UNROLLED = 16  # frames whose code is written out; more take longer to compile
BLOCKS = 4  # blocks of queries in causal attention …
LONG = 256  # … of at least this many cells
SCORES = 2**24  # the most in all frames that run at the same time: 64 MiB


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def attend_in_frames(
    q: Float[Array, "N S h e"], k: Float[Array, "N S h e"], v: Float[Array, "N S h e"], causal: bool = False
) -> Float[Array, "N S h e"]:
    """Returns softmax(q·kᵀ/√e)·v; operands rounded to bf16 where that pays, all else float32; float32 in and out.

    Args:
        causal: whether a query sees only its own key and those before it.
    """
    return _forward(q, k, v, causal)[0]


def _forward(q: Array, k: Array, v: Array, causal: bool) -> tuple[Array, tuple[Array, ...]]:
    q, k, v = (_rounded(_head_major(x)) for x in (q * q.shape[-1] ** -0.5, k, v))
    out, log_total = _each_frame(partial(_frame, causal), q, k, v)
    return _head_major(out), (q, k, v, out, log_total)


def _backward(causal: bool, saved: tuple[Array, ...], cotangent: Array) -> tuple[Array, Array, Array]:
    q, k, v, out, log_total = saved
    g = _head_major(cotangent)
    along = jnp.sum(g * out, axis=-1, keepdims=True)  # Σ_k p·dp of each row
    gradient = partial(_frame_gradient, causal)
    dq, dk_t, dv_t = _each_frame(gradient, q, k, v, _rounded(g), along, log_total)
    return (
        _head_major(dq) * q.shape[-1] ** -0.5,  # the saved queries contain this factor already
        dk_t.transpose(0, 3, 1, 2),
        dv_t.transpose(0, 3, 1, 2),
    )


def _each_frame(run: Callable[..., Any], *operands: Array) -> Any:
    _, heads, cells, _ = operands[0].shape
    unroll = max(1, min(UNROLLED, SCORES // (heads * cells**2)))
    return jax.lax.scan(lambda _, frame: (None, run(*frame)), None, operands, unroll=unroll)[1]


def _blocks(causal: bool, cells: int) -> list[slice]:
    """Returns the blocks of queries: all, or a few, each of which skips the keys that come after it."""
    size = -(-cells // BLOCKS) if causal and cells >= LONG else cells
    return [slice(begin, min(begin + size, cells)) for begin in range(0, cells, size)]


def _frame(causal: bool, q: Array, k: Array, v: Array) -> tuple[Array, Array]:
    """Returns one frame's output (h, S, e), and the log-sum of each row of its scores (h, S, 1)."""
    outs = []
    log_totals = []
    for rows in _blocks(causal, q.shape[1]):
        scores = _scores(q[:, rows], k[:, : rows.stop], causal)
        top = jnp.max(scores, axis=-1, keepdims=True)
        weights = _rounded(jnp.exp(scores - top))
        total = jnp.sum(weights, axis=-1, keepdims=True, dtype=jnp.float32)
        outs.append(_product("hqk,hke->hqe", weights, v[:, : rows.stop]) / total)
        log_totals.append(top + jnp.log(total))
    return jnp.concatenate(outs, axis=1), jnp.concatenate(log_totals, axis=1)


def _frame_gradient(
    causal: bool, q: Array, k: Array, v: Array, g: Array, along: Array, log_total: Array
) -> tuple[Array, Array, Array]:
    """Returns one frame's gradients: of queries (h, S, e), and of keys and values transposed, (h, e, S)."""
    queries = []
    keys = []
    values = []
    cells = q.shape[1]
    for rows in _blocks(causal, cells):
        visible_keys = k[:, : rows.stop]
        weights = _rounded(jnp.exp(_scores(q[:, rows], visible_keys, causal) - log_total[:, rows]))
        of_weights = _product("hqe,hke->hqk", g[:, rows], v[:, : rows.stop])
        of_scores = _rounded(weights * (of_weights - along[:, rows]))
        queries.append(_product("hqk,hke->hqe", of_scores, visible_keys))
        later = ((0, 0), (0, 0), (0, cells - rows.stop))  # keys that these rows do not see
        keys.append(jnp.pad(_product("heq,hqk->hek", _turned(q[:, rows]), of_scores), later))
        values.append(jnp.pad(_product("heq,hqk->hek", _turned(g[:, rows]), weights), later))
    return jnp.concatenate(queries, axis=1), sum(keys[1:], keys[0]), sum(values[1:], values[0])


def _scores(q: Array, k: Array, causal: bool) -> Array:
    scores = _product("hqe,hke->hqk", q, k)
    queries, keys = scores.shape[1:]
    before = scores.shape[2] - scores.shape[1]
    return jnp.where(jnp.tri(queries, keys, before, dtype=bool), scores, -jnp.inf) if causal else scores


def _rounded(x: Array) -> Array:
    """Returns an operand of a product: in bf16 where that pays."""
    if runtime.has_bf16_units():
        return x.astype(jnp.bfloat16)
    return x


def _turned(x: Array) -> Array:
    """Swaps the last two axes."""
    if runtime.has_bf16_units():
        return transposed_in_memory(x)
    return x.swapaxes(-1, -2)


def _head_major(x: Array) -> Array:
    """Swaps (N, S, h, e) to (N, h, S, e), or back."""
    return x.swapaxes(1, 2)


def _product(axes: str, a: Array, b: Array) -> Array:
    return jnp.einsum(axes, a, b, preferred_element_type=jnp.float32)


attend_in_frames.defvjp(_forward, _backward)
