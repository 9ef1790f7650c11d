"""The autoencoder of Stable Diffusion XL (``diffusers``' AutoencoderKL).

Images are in [-1, 1]; latents are the network's output, unscaled.

Axes: B images, H×W pixels, h×w cells, z latent channels.
"""

import flax.linen as nn
from jaxtyping import Array, Float

from rsjax.models.irasim.config import KLConfig
from rsjax.tokenizers.vae_blocks import Map, decode, encode


class Encoder(nn.Module):
    """Maps images to the posterior's mean and log-variance, (B, h, w, 2 z)."""

    config: KLConfig

    @nn.compact
    def __call__(self, images: Float[Array, "B H W 3"]) -> Map:
        cfg, out = self.config, 2 * self.config.latent_channels
        x = encode(images, cfg.widths, cfg.res_blocks, cfg.norm_groups, out, True, cfg.compute_dtype)
        return nn.Conv(out, (1, 1), name="quant_conv")(x)


class Decoder(nn.Module):
    """Maps latents to images, without clipping."""

    config: KLConfig

    @nn.compact
    def __call__(self, latents: Float[Array, "B h w z"]) -> Float[Array, "B H W 3"]:
        cfg = self.config
        x = nn.Conv(cfg.latent_channels, (1, 1), name="post_quant_conv")(latents)
        return decode(x, cfg.widths, cfg.res_blocks, cfg.norm_groups, 3, True, cfg.compute_dtype)
