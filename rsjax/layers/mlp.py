"""The MLP of a transformer block: LayerNorm, two linear layers with a GELU between them, and the residual sum."""

from functools import partial
from typing import Any

import flax.linen as nn
from jaxtyping import Array, Float

from rsjax.layers import platform
from rsjax.layers.dense import EPSILON, dense
from rsjax.layers.gelu import gelu
from rsjax.layers.gpu.mlp import Linear, Norm


def mlp(x: Float[Array, "B T S C"], norm: Norm | None, fc1: Linear, fc2: Linear, bf16: bool) -> Float[Array, "B T S C"]:
    """Returns x + fc2(gelu(fc1(layer_norm(x)))) with the exact GELU, or without the norm if it is None.

    Args:
        bf16: whether products may round their operands to bf16.
    """
    layers = partial(_layers, bf16=bf16)
    return platform.mlp(x, norm, fc1, fc2, layers) if bf16 else layers(x, norm, fc1, fc2)


def _layers(x: Array, norm: Norm | None, fc1: Linear, fc2: Linear, bf16: bool) -> Array:
    normed: Any = x
    if norm is not None:
        parameters = dict(zip(("scale", "bias"), norm, strict=True))
        normed = nn.LayerNorm(EPSILON, x.dtype, parent=None).apply({"params": parameters}, x)
    layers = partial(_feed_forward, bf16=bf16)
    return x + (platform.feed_forward(normed, fc1, fc2, layers) if bf16 else layers(normed, fc1, fc2))


def _feed_forward(x: Array, fc1: Linear, fc2: Linear, bf16: bool) -> Array:
    return dense(gelu(dense(x, *fc1, bf16)), *fc2, bf16)
