"""Layers of the public image autoencoders (VAE, VQ) of ``diffusers``: residual blocks, resampling, attention.

Convolutions have biases, norms are GroupNorms with epsilon 1e-6.

Axes: N images, h×w cells, C channels.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Map = Float[Array, "N h w C"]


def group_norm(groups: int, epsilon: float = 1e-6, name: str | None = None) -> nn.GroupNorm:
    """Returns a GroupNorm with the exact variance; the fast one, E[x²] - E[x]², is too inexact for parity."""
    return nn.GroupNorm(groups, epsilon=epsilon, use_fast_variance=False, name=name)


def conv3(features: int, name: str) -> nn.Conv:
    """Returns a 3×3 convolution that keeps the size."""
    return nn.Conv(features, (3, 3), padding=((1, 1), (1, 1)), name=name)


class ResBlock(nn.Module):
    """GroupNorm → SiLU → conv3, twice, plus the input (through a 1×1 convolution where the width changes)."""

    features: int
    groups: int

    @nn.compact
    def __call__(self, x: Map) -> Map:
        h = x
        for i in (1, 2):
            h = conv3(self.features, f"conv{i}")(nn.silu(group_norm(self.groups, name=f"norm{i}")(h)))
        if x.shape[-1] != self.features:
            x = nn.Conv(self.features, (1, 1), name="conv_shortcut")(x)
        return x + h


class Downsample(nn.Module):
    """Halves the size: a 3×3 convolution with stride 2, padded by one cell at the bottom and on the right."""

    @nn.compact
    def __call__(self, x: Map) -> Map:
        return nn.Conv(x.shape[-1], (3, 3), (2, 2), padding=((0, 1), (0, 1)), name="conv")(x)


class Upsample(nn.Module):
    """Doubles the size: repeats cells, then a 3×3 convolution."""

    @nn.compact
    def __call__(self, x: Map) -> Map:
        return conv3(x.shape[-1], "conv")(x.repeat(2, axis=1).repeat(2, axis=2))


class SelfAttention(nn.Module):
    """Attention with one head among all cells of an image, plus the input."""

    groups: int

    @nn.compact
    def __call__(self, x: Map) -> Map:
        n, h, w, width = x.shape
        normed = group_norm(self.groups, name="group_norm")(x).reshape(n, h * w, width)
        q, k, v = (nn.Dense(width, name=f"to_{name}")(normed) for name in "qkv")
        weights = jax.nn.softmax(jnp.einsum("nqc,nkc->nqk", q, k) * width**-0.5, axis=-1)
        return x + nn.Dense(width, name="to_out")(jnp.einsum("nqk,nkc->nqc", weights, v)).reshape(x.shape)
