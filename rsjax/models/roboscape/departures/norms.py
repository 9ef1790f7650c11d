"""Norms before temporal attention and before the heads: small models trained for few steps learn faster with both.

The public Genie has neither.
"""

from jaxtyping import Array, Float

from rsjax.layers.dense import layer_norm


def optional_norm(is_on: bool, name: str, x: Float[Array, "*N C"]) -> Float[Array, "*N C"]:
    """Returns the features, normalised by a LayerNorm called ``name`` if ``is_on``."""
    if not is_on:
        return x
    return layer_norm(name, x.dtype)(x)
