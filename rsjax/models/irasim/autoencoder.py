"""IRASim's autoencoder (networks, training, codec): SDXL's with public weights, or a small one that a run trains.

With ``KLConfig.depth`` it encodes depth maps as well, as images of colours; their latents are further channels of the
frame's.

Latents are standardised channel by channel. The parameters contain the channels' means and deviations ("latents"): for
SDXL the public factor, and for a trained autoencoder numbers that its training fits to its encoder's latents.

Axes: B images, H×W pixels, h×w cells, z latent channels, T frames.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, UInt8

from rsjax.clip import Video
from rsjax.config import Config
from rsjax.data.depth_color import color_to_depth, depth_to_color
from rsjax.data.loader import Arrays, Transform
from rsjax.data.normalization import Normalization
from rsjax.devices import divide
from rsjax.models.diffusion import latents as distributions
from rsjax.models.irasim import pretrained
from rsjax.models.irasim.config import KLConfig
from rsjax.tokenizers import magvit2, vae_blocks
from rsjax.tokenizers.codec import images_per_pass, in_chunks
from rsjax.tokenizers.flops import traced_flops
from rsjax.tokenizers.training import TokenizerImages, image_batch, require_no_adversarial
from rsjax.tokenizers.vae_blocks import Map
from rsjax.trainable import Params

Images = Float[Array, "B H W 3"]
Latents = Float[Array, "B h w z"]

SDXL_FACTOR = 0.13025  # the public code multiplies latents by it


class SdxlEncoder(nn.Module):
    """Maps images in [-1, 1] to the posterior's mean and log-variance, (B, h, w, 2 z), as ``diffusers`` does."""

    config: KLConfig

    @nn.compact
    def __call__(self, images: Images) -> Map:
        cfg = self.config
        out = 2 * cfg.latent_channels
        x = vae_blocks.encode(images, cfg.widths, cfg.res_blocks, cfg.norm_groups, out, True, cfg.compute_dtype)
        return nn.Conv(out, (1, 1), name="quant_conv")(x)


class SdxlDecoder(nn.Module):
    """Maps unscaled latents to images, without clipping."""

    config: KLConfig

    @nn.compact
    def __call__(self, latents: Latents) -> Images:
        cfg = self.config
        x = nn.Conv(cfg.latent_channels, (1, 1), name="post_quant_conv")(latents)
        return vae_blocks.decode(x, cfg.widths, cfg.res_blocks, cfg.norm_groups, 3, True, cfg.compute_dtype)


def networks(config: KLConfig) -> tuple[Any, Any]:
    """Returns the modules of the encoder and the decoder."""
    if config.network == "sdxl":
        return SdxlEncoder(config), SdxlDecoder(config)
    return magvit2.MagvitEncoder(config.convolutions), magvit2.MagvitDecoder(config.convolutions)


def init(config: KLConfig, key: Key[Array, ""]) -> Params:
    """Returns initial parameters of "encoder", "decoder" and "latents"."""
    encoder, decoder = networks(config)
    z = config.latent_channels
    size = 2 * config.downsampling
    scale = 0.0
    if config.network == "sdxl":
        scale = -math.log(SDXL_FACTOR)
    return {
        "encoder": encoder.init(key, jnp.zeros((1, size, size, 3)))["params"],
        "decoder": decoder.init(jax.random.fold_in(key, 1), jnp.zeros((1, 2, 2, z)))["params"],
        "latents": {"mean": jnp.zeros(z), "log_deviation": jnp.full(z, scale)},
    }


def encode(config: KLConfig, params: Params, images: Images) -> Float[Array, "B h w z2"]:
    """Returns the encoder's output, the mean and the log-variance of images' latents side by side."""
    return networks(config)[0].apply({"params": params["encoder"]}, images)


def posterior(config: KLConfig, params: Params, images: Images) -> tuple[Latents, Latents]:
    """Returns the mean and the log-variance of images' latents, which are not standardised."""
    return distributions.posterior(encode(config, params, images))


def decode(config: KLConfig, params: Params, latents: Latents) -> Images:
    """Decodes latents that are not standardised to images."""
    return networks(config)[1].apply({"params": params["decoder"]}, latents)


@dataclass(frozen=True)
class KLTraining(distributions.PosteriorTraining):
    """Trains the autoencoder to reconstruct frames, and depth maps with ``depth``, from a sample of their posterior."""

    config: KLConfig

    def __post_init__(self) -> None:
        require_no_adversarial(self.train, "IRASim's autoencoder")

    @classmethod
    def create(cls, config: Config) -> "KLTraining":
        """Returns the training of the autoencoder of a configuration whose model is IRASim."""
        return cls(config.autoencoder, config.tokenizer_train, config.clips.image_size)

    def init(self, key: Key[Array, ""]) -> Params:
        return init(self.config, key)

    def posterior(self, params: Params, frames: Images) -> tuple[Latents, Latents]:
        return posterior(self.config, params, frames)

    def decode(self, params: Params, latents: Latents) -> Images:
        return decode(self.config, params, latents)

    def transform(self) -> Transform:
        if self.config.depth == "none":
            return TokenizerImages(self.train.frames_per_clip, 0.0, "linear", self.train.flip)
        return TokenizerImages(self.train.frames_per_clip, self.train.depth_share, self.config.depth, self.train.flip)

    def batch(self, arrays: Arrays) -> distributions.Batch:
        count = arrays["images"].shape[1]  # frames of a clip
        index = count * arrays["index"][:, None] + np.arange(count, dtype=np.int32)
        return {"frames": image_batch(arrays), "index": index.reshape(-1)}

    def codec(self, params: Params, normalization: Normalization) -> "KLCodec":
        return KLCodec(self.config, params, normalization)

    def flops(self) -> dict[str, int]:
        config = replace(self.config, compute_dtype="float32")  # products of bf16 operands multiply padding too

        def mean(params: Params, images: Images) -> Latents:
            return posterior(config, params, images)[0]

        return traced_flops(self.shapes(), (1, self.image_size, self.image_size, 3), mean, partial(decode, config))

    def pretrained_shapes(self, directory: Path) -> Params:
        saved = pretrained.check_autoencoder(directory, self.config)
        return jax.eval_shape(partial(init, saved), jax.random.key(0))


@dataclass(frozen=True)
class KLCodec:
    """A trained autoencoder that takes and returns numpy arrays. The latents are standardised.

    If it encodes depth, C is 2 z, RGB's channels and then depth's; otherwise z.
    """

    config: KLConfig
    params: Params
    normalization: Normalization

    def encode(self, video: Video) -> dict[str, Float[np.ndarray, "B T h w C"]]:
        """Returns the posterior's "mean" and "deviation" of each frame; zeros for the depth of a clip without it.

        Raises:
            UserError: the video has depth, which is to be encoded, and no clip of the training data has.
        """
        made = self._posterior(video.rgb)
        if self.config.depth == "none":
            return made
        has_depth = video.has_depth
        ours = {name: np.zeros_like(x) for name, x in made.items()}
        if video.depth is not None and has_depth.any():
            for name, x in self._posterior(self._colors(video.depth[has_depth])).items():
                ours[name][has_depth] = x
        return {name: np.concatenate([x, ours[name]], axis=-1) for name, x in made.items()}

    def decode(self, tokens: dict[str, Any], has_depth: Bool[np.ndarray, " B"] | None = None) -> Video:
        """Decodes the latents "mean" to frames, with depth for the clips that have it and NaN for the others."""
        latents = np.asarray(tokens["mean"])
        z = self.config.latent_channels
        rgb = self._images(latents[..., :z])
        if self.config.depth == "none" or has_depth is None or not has_depth.any():
            return Video(rgb)
        metres = np.full(rgb.shape[:-1], np.nan, np.float32)
        colors = self._images(latents[has_depth, ..., z:])
        metres[has_depth] = color_to_depth(colors, *self.normalization.require_depth_range(), self.config.depth)
        return Video(rgb, metres)

    def depth_pictures(
        self, depth: Float[np.ndarray, "B T H W"]
    ) -> tuple[UInt8[np.ndarray, "B T H W 3"], UInt8[np.ndarray, "B T H W 3"]] | None:
        """Returns the colour maps of depth in metres, and these encoded and decoded; None without ``config.depth``."""
        if self.config.depth == "none":
            return None
        colors = self._colors(depth)
        return colors, self._images(self._posterior(colors)["mean"])

    def _colors(self, depth: Float[np.ndarray, "B T H W"]) -> UInt8[np.ndarray, "B T H W 3"]:
        assert self.config.depth != "none"
        near_far = self.normalization.require_depth_range()
        known = np.nan_to_num(depth, nan=0.0)  # NaN and 0 both say that it is unknown
        return depth_to_color(known, *near_far, self.config.depth).astype(np.uint8)

    def _posterior(self, images: UInt8[np.ndarray, "B T H W 3"]) -> dict[str, Float[np.ndarray, "B T h w z"]]:
        run = partial(self._run, distributions.encode_pixels, encode)
        made = in_chunks(run, images, 3, images_per_pass(images.shape[-2]))
        mean, deviation = np.split(made, 2, axis=-1)
        return {"mean": mean, "deviation": deviation}

    def _images(self, latents: Float[np.ndarray, "B T h w z"]) -> UInt8[np.ndarray, "B T H W 3"]:
        side = latents.shape[-2] * self.config.downsampling
        return in_chunks(partial(self._run, distributions.decode_pixels, decode), latents, 3, images_per_pass(side))

    def _run(self, function: Any, network: distributions.Network, chunk: np.ndarray) -> Any:
        return function(network, self.config, self.params, divide(chunk, self.params))
