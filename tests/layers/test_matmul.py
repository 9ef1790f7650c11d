import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.layers.cpu.matmul import matmul_bf16
from rsjax.layers.platform import linear


def rounded(x: np.ndarray) -> np.ndarray:
    return np.asarray(jnp.asarray(x, jnp.bfloat16), np.float32)


def products(x: jax.Array, w: jax.Array, cotangent: jax.Array) -> tuple[jax.Array, ...]:
    out, pull = jax.vjp(matmul_bf16, x, w)
    return out, *pull(cotangent)


@pytest.mark.parametrize("widths", [(33, 5), (5, 33)])  # the weight gradient transposes the narrower operand
def test_products_and_gradients_are_those_of_rounded_operands(widths: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    x, w, cotangent = (rng.normal(size=shape).astype(np.float32) for shape in ((7, widths[0]), widths, (7, widths[1])))
    out, to_x, to_w = jax.jit(products)(x, w, cotangent)
    expected = (
        rounded(x) @ rounded(w),
        rounded(cotangent) @ rounded(w).T,
        rounded(x).T @ rounded(cotangent),
    )
    for found, plain in zip((out, to_x, to_w), expected, strict=True):
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, plain, rtol=1e-5, atol=1e-5)
    assert not np.allclose(out, x @ w, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("units", [False, True])
def test_a_processor_without_bf16_units_multiplies_in_float32(monkeypatch: pytest.MonkeyPatch, units: bool) -> None:
    monkeypatch.setattr("rsjax.runtime.has_bf16_units", lambda: units)
    rng = np.random.default_rng(0)
    x, w = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((7, 33), (33, 5)))
    np.testing.assert_array_equal(linear(x, w), matmul_bf16(x, w) if units else x @ w)
