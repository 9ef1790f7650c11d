"""Tests of a wide MLP's kernels on GPUs: values and gradients, on the GPU, or else by Pallas' interpreter."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from rsjax.layers.gpu.feed_forward import feed_forward, fits
from tests.layers.kernels import INTERPRETED, in_dtypes

CASES = [
    ((1, 1, 128, 32), 128),
    ((2, 1, 128, 96), 256),  # several tiles of both axes, several steps
]


def reference(x: Array, fc1: Any, fc2: Any) -> Array:
    h = nn.gelu(x @ fc1[0] + fc1[1], approximate=False)
    return h @ fc2[0] + fc2[1]


@pytest.mark.parametrize(("shape", "hidden", "dtype", "bound"), in_dtypes(CASES, 3e-6))
def test_values_and_gradients_are_those_of_plain_layers(
    shape: tuple[int, ...], hidden: int, dtype: Any, bound: float
) -> None:
    assert fits(shape, hidden)
    keys = jax.random.split(jax.random.key(0), 6)
    width = shape[-1]
    fc1 = jax.random.normal(keys[0], (width, hidden)) / np.sqrt(width), jax.random.normal(keys[1], (hidden,))
    fc2 = jax.random.normal(keys[2], (hidden, width)) / np.sqrt(hidden), jax.random.normal(keys[3], (width,))
    x = (2 * jax.random.normal(keys[4], shape)).astype(dtype)
    cotangent = jax.random.normal(keys[5], shape).astype(dtype)
    out, pull = jax.vjp(lambda *operands: feed_forward(*operands, interpret=INTERPRETED), x, fc1, fc2)
    with jax.default_matmul_precision("highest"):
        true_out, true_pull = jax.vjp(reference, x.astype(jnp.float32), fc1, fc2)
        truths = jax.tree.leaves((true_out, true_pull(cotangent.astype(jnp.float32))))
    values = jax.tree.leaves((out, pull(cotangent)))
    assert [value.dtype for value in values] == [dtype, dtype, *[jnp.float32] * 4]
    for value, truth in zip(values, truths, strict=True):
        largest = float(jnp.max(jnp.abs(truth)))
        np.testing.assert_allclose(value.astype(jnp.float32) / largest, truth / largest, atol=bound)


@pytest.mark.parametrize(
    ("shape", "hidden"),
    [
        ((1, 1, 64, 1024), 4096),  # fewer rows than a tile
        ((1, 16, 256, 1024), 192),
        ((1, 16, 256, 48), 256),
    ],
)
def test_other_shapes_do_not_fit(shape: tuple[int, ...], hidden: int) -> None:
    assert not fits(shape, hidden)
