"""Compares kernels of attention with plain attention."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rsjax.layers.attention import attend as plain
from rsjax.layers.packed_attention import Over
from tests.layers.kernels import INTERPRETED


def reference(qkv: Array, over: Over) -> Array:
    q, k, v = (qkv[:, :, :, i] for i in range(3))
    if over == "cells":
        return plain(q, k, v, None)
    mask = jnp.tri(q.shape[1], dtype=bool)
    return plain(q.swapaxes(1, 2), k.swapaxes(1, 2), v.swapaxes(1, 2), mask).swapaxes(1, 2)


def assert_like_plain(attend: Any, over: Over, shape: tuple[int, ...], dtype: Any, bound: float) -> None:
    """Asserts that values and gradients are right up to ``bound`` of the largest."""
    qkv = (2 * jax.random.normal(jax.random.key(0), shape)).astype(dtype)
    cotangent = jax.random.normal(jax.random.key(1), (*shape[:3], *shape[4:])).astype(dtype)
    out, gradient = jax.vjp(lambda x: attend(x, over, interpret=INTERPRETED), qkv)
    true_out, true_gradient = jax.vjp(lambda x: reference(x, over), qkv.astype(jnp.float32))
    pairs = [(out, true_out), (gradient(cotangent)[0], true_gradient(cotangent.astype(jnp.float32))[0])]
    for value, truth in pairs:
        assert value.dtype == dtype
        largest = float(jnp.max(jnp.abs(truth)))
        np.testing.assert_allclose(value.astype(jnp.float32) / largest, truth / largest, atol=bound)
