import jax
import jax.numpy as jnp
import numpy as np

from rsjax.layers.gelu import gelu

X = jnp.concatenate([jnp.linspace(-12, 12, 1001), jnp.array([0.0, -40.0, 40.0])])


def test_values_and_gradients_are_those_of_the_exact_gelu() -> None:
    expected, backward = jax.vjp(lambda x: jax.nn.gelu(x, approximate=False), X)
    value, own_backward = jax.vjp(gelu, X)
    np.testing.assert_allclose(value, expected, atol=2e-6)
    np.testing.assert_allclose(own_backward(X)[0], backward(X)[0], atol=2e-5)
