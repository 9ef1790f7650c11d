"""Tests of a norm and the linear layer after it as one kernel: values, on a GPU, or else by Pallas' interpreter."""

from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.layers import platform
from rsjax.layers.gpu.norm_linear import fits, norm_linear
from tests.layers.kernels import INTERPRETED, in_dtypes


def reference(x: Any, norm: Any, kernel: Any) -> Any:
    scale, bias = norm
    return nn.LayerNorm(1e-5).apply({"params": {"scale": scale, "bias": bias}}, x) @ kernel


@pytest.mark.parametrize(
    ("shape", "outputs", "dtype", "bound"), in_dtypes([((2, 1, 64, 256), 192), ((1, 2, 64, 64), 64)], 3e-6)
)
def test_values_are_those_of_plain_layers(shape: tuple[int, ...], outputs: int, dtype: Any, bound: float) -> None:
    assert fits(shape, outputs)
    x, norm, kernel = operands(shape, outputs, dtype)
    out = norm_linear(x, norm, kernel, interpret=INTERPRETED)
    assert out.dtype == dtype
    with jax.default_matmul_precision("highest"):
        truth = reference(x.astype(jnp.float32), norm, kernel)
    largest = float(jnp.max(jnp.abs(truth)))
    np.testing.assert_allclose(out.astype(jnp.float32) / largest, truth / largest, atol=bound)


def test_gradients_are_those_of_plain_layers() -> None:
    x, norm, kernel = operands((1, 1, 64, 64), 64, jnp.bfloat16)

    def loss(run: Any, *operands: Any) -> Any:
        return jnp.sum(jnp.sin(run(*operands).astype(jnp.float32)))

    every = (0, 1, 2)
    found = jax.grad(partial(loss, partial(platform.norm_linear, layers=reference)), every)(x, norm, kernel)
    expected = jax.grad(partial(loss, reference), every)(x, norm, kernel)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def operands(shape: tuple[int, ...], outputs: int, dtype: Any) -> tuple[Any, Any, Any]:
    """Returns features, scale and bias of the norm, and the kernel."""
    width = shape[-1]
    keys = jax.random.split(jax.random.key(0), 4)
    x = (0.5 + 2 * jax.random.normal(keys[0], shape)).astype(dtype)
    norm = (1 + jax.random.normal(keys[1], (width,)) / 2, jax.random.normal(keys[2], (width,)))
    return x, norm, jax.random.normal(keys[3], (width, outputs)) / np.sqrt(width)


@pytest.mark.parametrize(
    ("shape", "outputs"), [((1, 1, 64, 512), 64), ((1, 1, 64, 64), 96), ((2, 1, 32, 64), 64), ((1, 1, 64, 96), 64)]
)
def test_other_shapes_do_not_fit(shape: tuple[int, ...], outputs: int) -> None:
    assert not fits(shape, outputs)
