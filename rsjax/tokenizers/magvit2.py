"""The MAGVIT-2 image tokenizer (paper §2.3 "Video Tokenization"; architecture of the public Open-MAGVIT2).

The full-size presets map 256² pixels to 16×16 tokens of 18 bits. Convolutions of the residual blocks have no bias,
downsampling pads symmetrically, and there is no attention. Submodules are named after the public checkpoints' keys.

Axes: B images, H×W pixels, h×w token cells, C channels, D code bits.
"""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt8

from rsjax.config import TokenizerConfig
from rsjax.devices import on_cpu
from rsjax.layers.convolution import Conv, Dtype, conv
from rsjax.layers.group_norm import GroupNorm
from rsjax.layers.platform import in_feature_dtype, with_transformed_kernels
from rsjax.tokenizers import lfq
from rsjax.trainable import Params


def space_to_depth(x: Float[Array, "B H W C"], factor: int) -> Float[Array, "B h w C2"]:
    """Moves factor×factor blocks of pixels into channels; the inverse of :func:`depth_to_space`."""
    if factor == 1:
        return x
    b, height, width, c = x.shape
    x = x.reshape(b, height // factor, factor, width // factor, factor, c)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(b, height // factor, width // factor, factor * factor * c)


def depth_to_space(x: Float[Array, "B h w C2"], factor: int) -> Float[Array, "B H W C"]:
    """Moves channels (factor, factor, C) into factor×factor blocks of pixels."""
    if factor == 1:
        return x
    b, height, width, c = x.shape
    x = x.reshape(b, height, width, factor, factor, c // factor**2)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(b, height * factor, width * factor, c // factor**2)


def _conv3(features: int, name: str, dtype: Dtype, bias: bool = False, stride: int = 1) -> Conv:
    # Symmetric padding even with stride 2, where 'SAME' would pad one side only.
    return conv(features, 3, dtype, name, stride, padding=((1, 1), (1, 1)), use_bias=bias)


class MagvitResBlock(nn.Module):
    """GroupNorm → swish → conv3, twice, plus the input (through a 1×1 convolution where the width changes).

    ``local``: no cell sees another one, neither through convolutions nor through norms.
    """

    features: int
    groups: int
    dtype: Dtype
    local: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "B h w C"]) -> Float[Array, "B h w C"]:
        h = x
        for i in (1, 2):
            h = nn.swish(GroupNorm(self.groups, local=self.local, name=f"norm{i}")(h))
            h = _inner_conv(self.features, f"conv{i}", self.dtype, self.local)(h)
        if x.shape[-1] != self.features:
            x = conv(self.features, 1, self.dtype, "nin_shortcut", use_bias=False)(x)
        return x + h


def _inner_conv(features: int, name: str, dtype: Dtype, local: bool) -> Conv:
    if local:
        return conv(features, 1, dtype, name, use_bias=False)
    return _conv3(features, name, dtype)


class AdaptiveGroupNorm(nn.Module):
    """GroupNorm whose scale and shift are linear in the codes' standard deviations and means over the cells."""

    groups: int

    @nn.compact
    def __call__(self, x: Float[Array, "B h w C"], codes: Float[Array, "B i j D"]) -> Float[Array, "B h w C"]:
        # The unbiased variance, torch's default, as in the public code.
        deviation = jnp.sqrt(jnp.var(codes, axis=(1, 2), ddof=1) + 1e-6)
        scale = nn.Dense(x.shape[-1], name="gamma")(deviation)
        shift = nn.Dense(x.shape[-1], name="beta")(jnp.mean(codes, axis=(1, 2)))
        normed = GroupNorm(self.groups, affine=False, name="norm")(x)
        return (scale[:, None, None] * normed + shift[:, None, None]).astype(x.dtype)


class MagvitEncoder(nn.Module):
    """Maps images in [-1, 1] to latents, whose signs are the code."""

    config: TokenizerConfig
    feature_dtype: Dtype = "float32"  # of the features between layers

    @nn.compact
    def __call__(self, images: Float[Array, "B H W 3"]) -> Float[Array, "B h w D"]:
        cfg = self.config
        local = cfg.local_codes
        dtype = cfg.compute_dtype
        x = space_to_depth(images, cfg.patch_size).astype(self.feature_dtype)
        x = _inner_conv(cfg.channels, "conv_in", dtype, local)(x)
        levels = len(cfg.channel_multipliers)
        for level, multiplier in enumerate(cfg.channel_multipliers):
            for i in range(cfg.res_blocks):
                name = f"down_{level}_block_{i}"
                x = MagvitResBlock(cfg.channels * multiplier, cfg.norm_groups, dtype, local, name=name)(x)
            if level < levels - 1:
                name = f"down_{level}_downsample"
                if local:
                    x = conv(x.shape[-1], 2, dtype, name, stride=2)(x)
                else:
                    x = _conv3(x.shape[-1], name, dtype, bias=True, stride=2)(x)
        for i in range(cfg.res_blocks):
            x = MagvitResBlock(x.shape[-1], cfg.norm_groups, dtype, local, name=f"mid_block_{i}")(x)
        x = nn.swish(GroupNorm(cfg.norm_groups, local=local, name="norm_out")(x))
        return conv(cfg.code_bits, 1, dtype, "conv_out")(x).astype(jnp.float32)


class MagvitDecoder(nn.Module):
    """Maps codes in {-1, +1} to images in about [-1, 1] (not clipped)."""

    config: TokenizerConfig
    feature_dtype: Dtype = "float32"

    @nn.compact
    def __call__(self, codes: Float[Array, "B h w D"]) -> Float[Array, "B H W 3"]:
        cfg = self.config
        dtype = self.config.compute_dtype
        x = codes.astype(self.feature_dtype)
        x = _conv3(cfg.channels * cfg.channel_multipliers[-1], "conv_in", dtype, bias=True)(x)
        for i in range(cfg.res_blocks):
            x = MagvitResBlock(x.shape[-1], cfg.norm_groups, dtype, name=f"mid_block_{i}")(x)
        for level in reversed(range(len(cfg.channel_multipliers))):
            if cfg.adaptive_norm:
                x = AdaptiveGroupNorm(cfg.norm_groups, name=f"adaptive_{level}")(x, codes)
            for i in range(cfg.res_blocks):
                features = cfg.channels * cfg.channel_multipliers[level]
                x = MagvitResBlock(features, cfg.norm_groups, dtype, name=f"up_{level}_block_{i}")(x)
            if level > 0:
                x = depth_to_space(_conv3(4 * x.shape[-1], f"up_{level}_upsample", dtype, bias=True)(x), 2)
        x = nn.swish(GroupNorm(cfg.norm_groups, name="norm_out")(x))
        x = _conv3(3 * cfg.patch_size**2, "conv_out", dtype, bias=True)(x)
        return depth_to_space(x.astype(jnp.float32), cfg.patch_size)


class Tokenizer(nn.Module):
    """Encoder, lookup-free quantiser and decoder; ``apply`` takes ``method`` "encode", "decode" or neither."""

    config: TokenizerConfig
    feature_dtype: Dtype = "float32"

    def setup(self) -> None:
        self.encoder = MagvitEncoder(self.config, self.feature_dtype)
        self.decoder = MagvitDecoder(self.config, self.feature_dtype)

    def __call__(self, images: Float[Array, "B H W 3"]) -> tuple[Float[Array, "B H W 3"], Float[Array, "B h w D"]]:
        """Returns (reconstruction, latents) of images in [-1, 1], differentiable through the quantiser."""
        latents = self.encoder(images)
        return self.decoder(lfq.quantize(latents)), latents

    def encode(self, images: Float[Array, "B H W 3"]) -> Int[Array, "B h w"]:
        """Encodes images 0–255 to tokens 0 … 2^D - 1."""
        return lfq.codes_to_tokens(self.encoder(to_unit(images)))

    def decode(self, tokens: Int[Array, "B h w"] | Float[Array, "B h w D"]) -> Float[Array, "B H W 3"]:
        """Decodes tokens, or codes, to images 0–255 (float32, clipped, not rounded)."""
        if jnp.issubdtype(tokens.dtype, jnp.integer):
            tokens = lfq.tokens_to_codes(tokens, self.config.code_bits)
        return to_pixels(self.decoder(tokens))

    def init_params(self, key: Array) -> Any:
        """Returns fresh parameters, which do not depend on the image size."""
        size = 2 * self.config.downsampling
        return self.init(key, jnp.zeros((1, size, size, 3)))["params"]


def run_tokenizer(config: TokenizerConfig, params: Params, inputs: Any, method: str | None = None) -> Any:
    """Returns what :class:`Tokenizer` returns; its features have ``compute_dtype`` where that is faster."""

    def run(dtype: Any) -> Any:
        return Tokenizer(config, dtype).apply({"params": params}, inputs, method=method)

    return in_feature_dtype(config.compute_dtype, run)


def for_many_pictures(config: TokenizerConfig, params: Params) -> Params:
    """Returns the parameters as a loop around "decode" reads them fastest: on a CPU, kernels are transformed once."""
    if config.compute_dtype == "float32" or not on_cpu():
        return params
    return params | {"decoder": with_transformed_kernels(params["decoder"])}


def to_unit(pixels: Any) -> Float[Array, "*batch"]:
    """Maps pixels 0–255 to [-1, 1]: x/127.5 - 1."""
    return jnp.asarray(pixels, jnp.float32) / 127.5 - 1.0


def to_pixels(images: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Maps [-1, 1] to pixels 0–255, clipped."""
    return jnp.clip((images + 1.0) * 127.5, 0.0, 255.0)


def to_frames(images: Float[Array, "*batch"]) -> UInt8[Array, "*batch"]:
    """Maps [-1, 1] to frames 0–255, rounded and clipped."""
    return jnp.round(to_pixels(images)).astype(jnp.uint8)
