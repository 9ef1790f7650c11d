"""LayerNorm of rows that a program of a GPU's kernel holds.

Axes: R rows of a tile, C width.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax.layers.parameters import EPSILON


def layer_norm(x: Float[Array, "R C"], norm: Any) -> Float[Array, "R C"]:
    """Returns the LayerNorm of rows with this scale and bias, in the number format of x; x itself without them."""
    if not norm:
        return x
    scale, bias = norm
    return (whiten(x.astype(jnp.float32))[0] * scale + bias).astype(x.dtype)


def whiten(x: Float[Array, "R C"]) -> tuple[Float[Array, "R C"], Float[Array, "R 1"]]:
    """Returns rows of mean 0 and variance 1, and one divided by the deviation that rows had."""
    centred = x - jnp.mean(x, axis=1, keepdims=True)
    root = jax.lax.rsqrt(jnp.mean(centred * centred, axis=1, keepdims=True) + EPSILON)
    return centred * root, root
