"""Tests of a residual sum and its LayerNorm as one kernel a pass, by Pallas' interpreter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from rsjax.layers.gpu.layer_norm import add_norm, fits


def plain(x: Array, update: Array | None, scale: Array, bias: Array) -> tuple[Array, Array]:
    total = x
    if update is not None:
        total = x + update
    return total, jax.nn.standardize(total, axis=-1, epsilon=1e-5) * scale + bias


@pytest.mark.parametrize("shape", [(2, 4, 64, 128), (1, 2, 16, 1024)])
@pytest.mark.parametrize(("dtype", "bound"), [(jnp.float32, 1e-6), (jnp.bfloat16, 1e-2)])
@pytest.mark.parametrize("added", [True, False])
def test_values_and_gradients_are_those_of_the_plain_norm(
    shape: tuple[int, ...], dtype: jnp.dtype, bound: float, added: bool
) -> None:
    assert fits(shape)
    keys = jax.random.split(jax.random.key(0), 6)
    x, update, of_total, of_normed = (jax.random.normal(key, shape).astype(dtype) + 0.5 for key in keys[:4])
    scale, bias = (jax.random.normal(key, shape[-1:]) for key in keys[4:])
    operands = (x, update if added else None, scale, bias)
    exact = jax.tree.map(lambda a: a.astype(jnp.float32), operands)
    results, gradient = jax.vjp(lambda *a: add_norm(*a, interpret=True), *operands)
    true_results, true_gradient = jax.vjp(plain, *exact)
    found = (results, gradient((of_total, of_normed)))
    truth = (true_results, true_gradient((of_total.astype(jnp.float32), of_normed.astype(jnp.float32))))
    for value, true in zip(jax.tree.leaves(found), jax.tree.leaves(truth), strict=True):
        largest = float(jnp.max(jnp.abs(true)))
        np.testing.assert_allclose(value.astype(jnp.float32) / largest, true / largest, atol=bound)


@pytest.mark.parametrize("shape", [(2, 16, 256, 96), (2, 16, 256, 64), (2, 1, 16, 128)])
def test_other_shapes_do_not_fit(shape: tuple[int, ...]) -> None:
    assert not fits(shape)
