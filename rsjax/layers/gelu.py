"""GELU with few passes over memory: a tenth of a small model's training step on a CPU is in this function."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_HALF_ROOT = float(np.sqrt(0.5))
_DENSITY = float(1 / np.sqrt(2 * np.pi))  # of the normal distribution at 0


@jax.custom_vjp
def gelu(x: Float[Array, "*N"]) -> Float[Array, "*N"]:
    """Returns the exact GELU x·Φ(x), with Φ by erf as torch computes it; XLA's erfc takes three times as long.

    It is computed in float32 and has the number format of x.
    """
    wide = x.astype(jnp.float32)
    return (wide * _share(wide)).astype(x.dtype)


def _share(x: Array) -> Array:
    """Returns Φ(x), the normal distribution's share below x."""
    return 0.5 + 0.5 * jax.lax.erf(x * _HALF_ROOT)


def _forward(x: Array) -> tuple[Array, Array]:
    return gelu(x), x


def _backward(x: Array, cotangent: Array) -> tuple[Array]:
    # Recomputed from x: what the forward pass would store is as large as x.
    wide = x.astype(jnp.float32)
    slope = _share(wide) + wide * jnp.exp(-0.5 * jnp.square(wide)) * _DENSITY
    return ((cotangent * slope).astype(x.dtype),)


gelu.defvjp(_forward, _backward)
