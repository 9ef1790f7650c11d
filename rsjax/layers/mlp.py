"""The MLP of a transformer block: LayerNorm, two linear layers with a GELU between them, and the residual sum."""

from jaxtyping import Array, Float

from rsjax.layers import platform
from rsjax.layers.dense import dense, normalised
from rsjax.layers.gelu import gelu
from rsjax.layers.parameters import Linear, Norm


def mlp(x: Float[Array, "B T S C"], norm: Norm | None, fc1: Linear, fc2: Linear, bf16: bool) -> Float[Array, "B T S C"]:
    """Returns x + fc2(gelu(fc1(layer_norm(x)))) with the exact GELU, or without the norm if it is None.

    Args:
        bf16: whether products may round their operands to bf16.
    """

    def layers(x: Array, norm: Norm | None, fc1: Linear, fc2: Linear) -> Array:
        normed = x if norm is None else normalised(x, norm)
        return x + feed_forward(normed, fc1, fc2, bf16)

    if bf16:
        return platform.mlp(x, norm, fc1, fc2, layers)
    return layers(x, norm, fc1, fc2)


def feed_forward(x: Float[Array, "B T S C"], fc1: Linear, fc2: Linear, bf16: bool) -> Float[Array, "B T S C"]:
    """Returns fc2(gelu(fc1(x))), as :func:`mlp` computes it."""

    def layers(x: Array, fc1: Linear, fc2: Linear) -> Array:
        return dense(gelu(dense(x, *fc1, bf16)), *fc2, bf16)

    if bf16:
        return platform.feed_forward(x, fc1, fc2, layers)
    return layers(x, fc1, fc2)
