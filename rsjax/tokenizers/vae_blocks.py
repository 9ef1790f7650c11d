"""The public image autoencoders (VAE, VQ) of ``diffusers``: both halves, and their layers.

Convolutions have biases, norms are GroupNorms with epsilon 1e-6. ``rsjax/tools/convert/table.py`` lists the public
names of these modules.

Axes: N images, h×w cells, C channels.
"""

from collections.abc import Callable, Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax.layers.convolution import Dtype, conv
from rsjax.layers.group_norm import GroupNorm

Map = Float[Array, "N h w C"]


class VaeResBlock(nn.Module):
    """GroupNorm → SiLU → conv3, twice, plus the input (through a 1×1 convolution where the width changes)."""

    features: int
    groups: int
    dtype: Dtype

    @nn.compact
    def __call__(self, x: Map) -> Map:
        h = x
        for i in (1, 2):
            h = conv(self.features, 3, self.dtype, f"conv{i}")(nn.silu(GroupNorm(self.groups, name=f"norm{i}")(h)))
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

    dtype: Dtype

    @nn.compact
    def __call__(self, x: Map) -> Map:
        return conv(x.shape[-1], 3, self.dtype, "conv")(x.repeat(2, axis=1).repeat(2, axis=2))


class SelfAttention(nn.Module):
    """Attention with one head among all cells of an image, plus the input."""

    groups: int

    @nn.compact
    def __call__(self, x: Map) -> Map:
        n, h, w, width = x.shape
        normed = GroupNorm(self.groups, name="group_norm")(x).reshape(n, h * w, width)
        q, k, v = (nn.Dense(width, name=f"to_{name}")(normed) for name in "qkv")
        weights = jax.nn.softmax(jnp.einsum("nqc,nkc->nqk", q, k) * width**-0.5, axis=-1)
        return x + nn.Dense(width, name="to_out")(jnp.einsum("nqk,nkc->nqc", weights, v)).reshape(x.shape)


def middle(x: Map, groups: int, attention: bool, dtype: Dtype) -> Map:
    """Computes two residual blocks, optionally with attention between them, in the module that calls it."""
    x = VaeResBlock(x.shape[-1], groups, dtype, name="mid_block_0")(x)
    if attention:
        x = SelfAttention(groups, name="mid_attention")(x)
    return VaeResBlock(x.shape[-1], groups, dtype, name="mid_block_1")(x)


def encode(
    x: Map,
    widths: Sequence[int],
    res_blocks: int,
    groups: int,
    out: int,
    attention: bool,
    dtype: Dtype,
    after: Callable[[Map], Map] = lambda x: x,
) -> Map:
    """Computes the encoder in the compact module that calls it; every level but the last halves the grid.

    Args:
        widths: channels of each level.
        out: channels of the result.
        attention: whether the middle has attention.
        dtype: of the operands of 3×3 convolutions (:mod:`rsjax.layers.platform`).
        after: applied to the features after each level.
    """
    x = conv(widths[0], 3, dtype, "conv_in")(x)
    for level, width in enumerate(widths):
        for i in range(res_blocks):
            x = VaeResBlock(width, groups, dtype, name=f"down_{level}_block_{i}")(x)
        if level < len(widths) - 1:
            x = Downsample(name=f"down_{level}_downsample")(x)
        x = after(x)
    x = middle(x, groups, attention, dtype)
    return conv(out, 3, dtype, "conv_out")(nn.silu(GroupNorm(groups, name="norm_out")(x)))


def decode(
    x: Map,
    widths: Sequence[int],
    res_blocks: int,
    groups: int,
    out: int,
    attention: bool,
    dtype: Dtype,
    after: Callable[[Map], Map] = lambda x: x,
) -> Map:
    """Inverts :func:`encode` with one more residual block at each level; ``after`` also follows the middle."""
    x = after(middle(conv(widths[-1], 3, dtype, "conv_in")(x), groups, attention, dtype))
    for level, width in enumerate(reversed(widths)):
        for i in range(res_blocks + 1):
            x = VaeResBlock(width, groups, dtype, name=f"up_{level}_block_{i}")(x)
        if level < len(widths) - 1:
            x = Upsample(dtype, name=f"up_{level}_upsample")(x)
        x = after(x)
    return conv(out, 3, dtype, "conv_out")(nn.silu(GroupNorm(groups, name="norm_out")(x)))
