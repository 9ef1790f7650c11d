"""The autoencoder of Stable Diffusion XL (``diffusers``' AutoencoderKL): convolutions, and attention in the middle.

Submodules are named after the public keys. Images are in [-1, 1]; latents are as the network makes them, unscaled.

Axes: B images, H×W pixels, h×w cells, C channels, z latent channels.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax.config import KLConfig
from rsjax.models.roboscape.attention import attend

Features = Float[Array, "B h w C"]


def _norm(config: KLConfig, name: str) -> nn.GroupNorm:
    # The fast variance, E[x²] - E[x]², is too inexact for parity with the public weights.
    return nn.GroupNorm(config.norm_groups, epsilon=1e-6, use_fast_variance=False, name=name)


def _conv3(features: int, name: str) -> nn.Conv:
    return nn.Conv(features, (3, 3), padding=((1, 1), (1, 1)), name=name)


class ResBlock(nn.Module):
    """GroupNorm → SiLU → conv3, twice, plus the input, through a 1×1 convolution where the width changes."""

    config: KLConfig
    features: int

    @nn.compact
    def __call__(self, x: Features) -> Features:
        h = x
        for i in (1, 2):
            h = _conv3(self.features, f"conv{i}")(nn.silu(_norm(self.config, f"norm{i}")(h)))
        if x.shape[-1] != self.features:
            x = nn.Conv(self.features, (1, 1), name="conv_shortcut")(x)
        return x + h


class Middle(nn.Module):
    """A residual block, attention among all cells with one head, and another residual block."""

    config: KLConfig

    @nn.compact
    def __call__(self, x: Features) -> Features:
        width = x.shape[-1]
        x = ResBlock(self.config, width, name="resnets_0")(x)
        h = _norm(self.config, "group_norm")(x).reshape(len(x), -1, width)
        q, k, v = (nn.Dense(width, name=f"to_{name}")(h)[:, :, None] for name in "qkv")
        x = x + nn.Dense(width, name="to_out")(attend(q, k, v, None)[:, :, 0]).reshape(x.shape)
        return ResBlock(self.config, width, name="resnets_1")(x)


class Encoder(nn.Module):
    """Maps images to the posterior's mean and log-variance, (B, h, w, 2 z)."""

    config: KLConfig

    @nn.compact
    def __call__(self, images: Float[Array, "B H W 3"]) -> Features:
        cfg = self.config
        x = _conv3(cfg.channels, "conv_in")(images)
        last = len(cfg.channel_multipliers) - 1
        for level, multiplier in enumerate(cfg.channel_multipliers):
            for i in range(cfg.res_blocks):
                x = ResBlock(cfg, cfg.channels * multiplier, name=f"down_{level}_resnets_{i}")(x)
            if level < last:
                # Padded at the bottom and on the right alone.
                down = nn.Conv(x.shape[-1], (3, 3), (2, 2), ((0, 1), (0, 1)), name=f"down_{level}_downsample")
                x = down(x)
        x = nn.silu(_norm(cfg, "conv_norm_out")(Middle(cfg, name="mid")(x)))
        x = _conv3(2 * cfg.latent_channels, "conv_out")(x)
        return nn.Conv(2 * cfg.latent_channels, (1, 1), name="quant_conv")(x)


class Decoder(nn.Module):
    """Maps latents to images, not clipped."""

    config: KLConfig

    @nn.compact
    def __call__(self, latents: Float[Array, "B h w z"]) -> Float[Array, "B H W 3"]:
        cfg = self.config
        x = nn.Conv(cfg.latent_channels, (1, 1), name="post_quant_conv")(latents)
        x = _conv3(cfg.channels * cfg.channel_multipliers[-1], "conv_in")(x)
        x = Middle(cfg, name="mid")(x)
        for level in reversed(range(len(cfg.channel_multipliers))):
            for i in range(cfg.res_blocks + 1):
                features = cfg.channels * cfg.channel_multipliers[level]
                x = ResBlock(cfg, features, name=f"up_{level}_resnets_{i}")(x)
            if level > 0:
                x = jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)
                x = _conv3(x.shape[-1], f"up_{level}_upsample")(x)
        return _conv3(3, "conv_out")(nn.silu(_norm(cfg, "conv_norm_out")(x)))
