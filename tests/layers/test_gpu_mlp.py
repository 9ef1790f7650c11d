"""Tests of the MLP as one kernel a pass on GPUs: values and gradients, on the GPU, or else by Pallas' interpreter."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from rsjax.layers.gpu.mlp import fits, mlp
from tests.layers.kernels import INTERPRETED, in_dtypes

CASES = [
    (True, (1, 2, 64, 64), 128),
    (True, (2, 1, 128, 256), 192),  # several tiles of each clip, several chunks
    (False, (2, 1, 128, 256), 192),
]


def parameters(width: int, hidden: int) -> tuple[Any, Any, Any]:
    keys = iter(jax.random.split(jax.random.key(0), 6))

    def numbers(*shape: int, around: float = 0.0) -> Array:
        return around + jax.random.normal(next(keys), shape) / np.sqrt(shape[0] if len(shape) > 1 else 4)

    norm = numbers(width, around=1.0), numbers(width)
    return norm, (numbers(width, hidden), numbers(hidden)), (numbers(hidden, width), numbers(width))


def reference(x: Array, norm: Any, fc1: Any, fc2: Any) -> Array:
    normed: Any = x
    if norm is not None:
        scale, bias = norm
        normed = nn.LayerNorm(1e-5).apply({"params": {"scale": scale, "bias": bias}}, x)
    h = nn.gelu(normed @ fc1[0] + fc1[1], approximate=False)
    return x + h @ fc2[0] + fc2[1]


@pytest.mark.parametrize(("has_norm", "shape", "hidden", "dtype", "bound"), in_dtypes(CASES, 3e-6))
def test_values_and_gradients_are_those_of_plain_layers(
    has_norm: bool, shape: tuple[int, ...], hidden: int, dtype: Any, bound: float
) -> None:
    assert fits(shape, hidden)
    norm, fc1, fc2 = parameters(shape[-1], hidden)
    norm = norm if has_norm else None
    x = (0.5 + 2 * jax.random.normal(jax.random.key(1), shape)).astype(dtype)
    cotangent = jax.random.normal(jax.random.key(2), shape).astype(dtype)
    out, pull = jax.vjp(lambda *operands: mlp(*operands, interpret=INTERPRETED), x, norm, fc1, fc2)
    with jax.default_matmul_precision("highest"):
        true_out, true_pull = jax.vjp(reference, x.astype(jnp.float32), norm, fc1, fc2)
        truths = jax.tree.leaves((true_out, true_pull(cotangent.astype(jnp.float32))))
    values = jax.tree.leaves((out, pull(cotangent)))
    assert [value.dtype for value in values] == [dtype, dtype] + [jnp.float32] * (len(values) - 2)
    for value, truth in zip(values, truths, strict=True):
        largest = float(jnp.max(jnp.abs(truth)))
        np.testing.assert_allclose(value.astype(jnp.float32) / largest, truth / largest, atol=bound)


def test_the_gelu_is_exact() -> None:
    x = jnp.linspace(-8, 8, 128 * 64).reshape(1, 1, 128, 64)
    zeros = jnp.zeros(64)
    for gain in (1.0, 3.0):
        kernel = gain * jnp.eye(64)
        out = mlp(x, None, (kernel, zeros), (jnp.eye(64), zeros), interpret=INTERPRETED) - x
        np.testing.assert_allclose(out, nn.gelu(gain * x, approximate=False), atol=2e-6)


@pytest.mark.parametrize(
    ("shape", "hidden"),
    [
        ((1, 16, 256, 384), 1024),  # no power of two
        ((1, 16, 256, 512), 2048),  # too wide for a tile
        ((1, 1, 32, 256), 1024),  # fewer rows than a tile
        ((1, 16, 256, 256), 48),
    ],
)
def test_other_shapes_do_not_fit(shape: tuple[int, ...], hidden: int) -> None:
    assert not fits(shape, hidden)
