import jax
import jax.numpy as jnp
import numpy as np

from rsjax.model.matmul import matmul_bf16


def rounded(x: np.ndarray) -> np.ndarray:
    return np.asarray(jnp.asarray(x, jnp.bfloat16), np.float32)


def test_products_and_gradients_are_those_of_rounded_operands() -> None:
    rng = np.random.default_rng(0)
    x, w, cotangent = (rng.normal(size=shape).astype(np.float32) for shape in ((7, 33), (33, 5), (7, 5)))
    out, pull = jax.vjp(matmul_bf16, jnp.array(x), jnp.array(w))
    to_x, to_w = pull(jnp.array(cotangent))
    expected = (
        rounded(x) @ rounded(w),
        rounded(cotangent) @ rounded(w).T,
        rounded(x).T @ rounded(cotangent),
    )
    for found, plain in zip((out, to_x, to_w), expected, strict=True):
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, plain, rtol=1e-5, atol=1e-5)
    assert not np.allclose(out, x @ w, rtol=1e-5, atol=1e-5)
