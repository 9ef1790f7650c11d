"""The exact GELU and its derivative in a kernel."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float


def gelu(x: Float[Array, "R K"]) -> tuple[Float[Array, "R K"], Float[Array, "R K"]]:
    """Returns x·Φ(x) and its derivative, with Φ by erf.

    The error of Φ is at most 1e-7 (Abramowitz and Stegun, Handbook of Mathematical Functions, 1964, 7.1.26). Its
    exponential is that of the derivative, and Triton has no erf.
    """
    t = 1 / (1 + (0.3275911 * math.sqrt(0.5)) * jnp.abs(x))
    polynomial = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))))
    bell = jnp.exp2(x * x * (-0.5 * math.log2(math.e)))
    tail = 0.5 * polynomial * bell
    share = jnp.where(x < 0, tail, 1 - tail)
    return x * share, share + x * bell * (1 / math.sqrt(2 * math.pi))
