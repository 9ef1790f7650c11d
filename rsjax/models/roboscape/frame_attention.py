"""Attention among the cells of a frame with bf16 products and a hand-written gradient, fast on CPUs.

A frame's scores are the largest arrays of a training step. They are not kept: the gradient recomputes them from
queries, keys and each row's log-sum, a few frames at a time, so that they stay in the processor's cache. Every product
contracts the last axis of its first operand, the only form for which XLA's CPU backend has fast bf16 kernels. So the
gradients of keys and values transpose their small operands in memory, never the scores.

Axes: N frames, S cells (q of the queries, k of the keys), h heads, e head width.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax.models.roboscape.matmul import transposed_in_memory

SCORES_AT_ONCE = 2**19  # 2 MB, which fits a core's cache


@jax.custom_vjp
def attend_in_frames(
    q: Float[Array, "N S h e"], k: Float[Array, "N S h e"], v: Float[Array, "N S h e"]
) -> Float[Array, "N S h e"]:
    """Returns softmax(q·kᵀ/√e)·v: operands rounded to bf16, accumulation and softmax float32; float32 in and out."""
    return _forward(q, k, v)[0]


def _forward(q: Array, k: Array, v: Array) -> tuple[Array, tuple[Array, ...]]:
    q, k, v = (_head_major(x).astype(jnp.bfloat16) for x in (q * q.shape[-1] ** -0.5, k, v))
    scores = _product("nhqe,nhke->nhqk", q, k)
    top = jnp.max(scores, axis=-1, keepdims=True)
    weights = jnp.exp(scores - top)
    total = jnp.sum(weights, axis=-1, keepdims=True)
    out = _product("nhqk,nhke->nhqe", weights.astype(jnp.bfloat16), v) / total
    return _head_major(out), (q, k, v, out, top + jnp.log(total))


def _backward(saved: tuple[Array, ...], cotangent: Array) -> tuple[Array, Array, Array]:
    q, k, v, out, log_total = saved
    g = _head_major(cotangent)
    along = jnp.sum(g * out, axis=-1, keepdims=True)  # Σ_k p·dp of each row
    g = g.astype(jnp.bfloat16)
    parts = (q, k, v, g, transposed_in_memory(q), transposed_in_memory(g), along, log_total)
    at_once = max(1, SCORES_AT_ONCE // (q.shape[1] * q.shape[2] ** 2))
    if at_once >= len(q):
        dq, dk_t, dv_t = jax.vmap(_frame_gradient)(*parts)
    else:
        dq, dk_t, dv_t = jax.lax.map(lambda frame: _frame_gradient(*frame), parts, batch_size=at_once)
    return (
        _head_major(dq) * q.shape[-1] ** -0.5,  # the saved queries hold this factor already
        dk_t.transpose(0, 3, 1, 2),
        dv_t.transpose(0, 3, 1, 2),
    )


def _frame_gradient(
    q: Array, k: Array, v: Array, g: Array, q_t: Array, g_t: Array, along: Array, log_total: Array
) -> tuple[Array, Array, Array]:
    """Returns one frame's gradients: of queries (h, S, e), and of keys and values transposed, (h, e, S)."""
    weights = jnp.exp(_product("hqe,hke->hqk", q, k) - log_total)
    of_weights = _product("hqe,hke->hqk", g, v)
    of_scores = (weights * (of_weights - along)).astype(jnp.bfloat16)
    return (
        _product("hqk,hke->hqe", of_scores, k),
        _product("heq,hqk->hek", q_t, of_scores),
        _product("heq,hqk->hek", g_t, weights.astype(jnp.bfloat16)),
    )


def _head_major(x: Array) -> Array:
    """Swaps (N, S, h, e) to (N, h, S, e), or back."""
    return x.swapaxes(1, 2)


def _product(axes: str, a: Array, b: Array) -> Array:
    return jnp.einsum(axes, a, b, preferred_element_type=jnp.float32)


attend_in_frames.defvjp(_forward, _backward)
