"""CogVideoX's autoencoder of videos: its convolutions are causal in time, and it takes videos in successive pieces.

Norms see the frames of one piece (8 frames in the encoder, 2 latent frames in the decoder), so videos must be cut as in
the public code. Between pieces, every causal convolution keeps its last two frames in the collection "past".

Axes: B videos, T frames of a piece, H×W pixels or cells, C channels, z latent channels.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax.layers.convolution import Dtype
from rsjax.layers.group_norm import GroupNorm
from rsjax.layers.platform import convolve_video
from rsjax.models.cogvideox.config import DECODED, ENCODED, CausalVAEConfig
from rsjax.tokenizers.magvit2 import depth_to_space, space_to_depth
from rsjax.tokenizers.vae_blocks import Downsample, Upsample
from rsjax.trainable import Params

Video = Float[Array, "B T H W C"]

SIZE = 3  # frames, rows and columns that a convolution covers
TIME_LEVELS = 2  # levels that halve or double time
PAST = "past"


class CausalConv(nn.Module):
    """A convolution over 3×3 cells of a frame and the two before it; copies of the first frame precede that frame."""

    features: int
    dtype: Dtype

    @nn.compact
    def __call__(self, x: Video) -> Video:
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (SIZE, SIZE, SIZE, x.shape[-1], self.features))
        if self.has_variable(PAST, "frames"):
            past: Video = self.get_variable(PAST, "frames")
        else:
            past = jnp.repeat(x[:, :1], SIZE - 1, axis=1)
        frames = jnp.concatenate([past, x], axis=1)
        if self.is_mutable_collection(PAST):
            self.put_variable(PAST, "frames", frames[:, 1 - SIZE :])
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        return convolve_video(frames, kernel, self.dtype == "bfloat16") + bias


def by_frame(x: Video, function: Any) -> Video:
    """Applies a function of images to all frames."""
    made = function(x.reshape(-1, *x.shape[2:]))
    return made.reshape(*x.shape[:2], *made.shape[1:])


class CellNorm(nn.Module):
    """GroupNorm, then a scale and a shift of each cell that depend on the latents there."""

    groups: int

    @nn.compact
    def __call__(self, x: Video, latents: Float[Array, "B t h w z"]) -> Video:
        # Repeating cells after the layers gives the same result as before them, with less work.
        scale, shift = (spread(nn.Dense(x.shape[-1], name=f"conv_{name}")(latents), x) for name in "yb")
        return GroupNorm(self.groups, name="norm_layer")(x) * scale + shift


def spread(cells: Video, like: Video) -> Video:
    """Repeats cells to the frames, rows and columns of another video; in time as :func:`_repeat` does."""
    frames = like.shape[1]
    times = like.shape[2] // cells.shape[2]
    alone = cells.shape[1] % 2
    if cells.shape[1] != frames:
        cells = _repeat(cells, (frames - alone) // (cells.shape[1] - alone))
    return cells.repeat(times, axis=2).repeat(times, axis=3)


def _repeat(x: Video, times: int) -> Video:
    """Repeats frames; the first of an odd number is not repeated."""
    alone = x.shape[1] % 2
    return jnp.concatenate([x[:, :alone], x[:, alone:].repeat(times, axis=1)], axis=1)


class CausalResBlock(nn.Module):
    """Norm → SiLU → causal convolution, twice, plus the input, through a linear layer where the width changes."""

    features: int
    groups: int
    dtype: Dtype

    @nn.compact
    def __call__(self, x: Video, latents: Float[Array, "B t h w z"] | None = None) -> Video:
        h = x
        for i in (1, 2):
            if latents is None:
                h = GroupNorm(self.groups, name=f"norm{i}")(h)
            else:
                h = CellNorm(self.groups, name=f"norm{i}")(h, latents)
            h = CausalConv(self.features, self.dtype, name=f"conv{i}")(nn.silu(h))
        if x.shape[-1] != self.features:
            x = nn.Dense(self.features, name="conv_shortcut")(x)
        return x + h


class CausalEncoder(nn.Module):
    """Maps a piece of a video to the posterior's mean and log-variance, (B, t, h, w, 2 z)."""

    config: CausalVAEConfig

    @nn.compact
    def __call__(self, frames: Float[Array, "B T H W 3"]) -> Video:
        cfg = self.config
        last = len(cfg.widths) - 1
        dtype = cfg.compute_dtype
        x = by_frame(frames, partial(space_to_depth, factor=cfg.patch_size))
        x = CausalConv(cfg.widths[0], dtype, name="conv_in")(x)
        for level, width in enumerate(cfg.widths):
            for i in range(cfg.res_blocks):
                x = CausalResBlock(width, cfg.norm_groups, dtype, name=f"down_{level}_block_{i}")(x)
            if level < last:
                if level < TIME_LEVELS and x.shape[1] > 1:
                    # Pairs of frames are averaged; the first of an odd number stays as it is. Not by a mean over an
                    # axis of pairs: XLA would draw the convolution before it into a sum that runs on one core.
                    alone = x.shape[1] % 2
                    pairs = (x[:, alone::2] + x[:, alone + 1 :: 2]) / 2
                    x = jnp.concatenate([x[:, :alone], pairs], axis=1)
                x = by_frame(x, Downsample(name=f"down_{level}_downsample"))
        for i in range(2):
            x = CausalResBlock(cfg.widths[-1], cfg.norm_groups, dtype, name=f"mid_block_{i}")(x)
        x = nn.silu(GroupNorm(cfg.norm_groups, name="norm_out")(x))
        return CausalConv(2 * cfg.latent_channels, dtype, name="conv_out")(x)


class CausalDecoder(nn.Module):
    """Maps a piece of latents to frames, not clipped."""

    config: CausalVAEConfig

    @nn.compact
    def __call__(self, latents: Float[Array, "B t h w z"]) -> Float[Array, "B T H W 3"]:
        cfg = self.config
        last = len(cfg.widths) - 1
        dtype = cfg.compute_dtype
        x = CausalConv(cfg.widths[-1], dtype, name="conv_in")(latents)
        for i in range(2):
            x = CausalResBlock(cfg.widths[-1], cfg.norm_groups, dtype, name=f"mid_block_{i}")(x, latents)
        for level, width in enumerate(reversed(cfg.widths)):
            for i in range(cfg.res_blocks + 1):
                x = CausalResBlock(width, cfg.norm_groups, dtype, name=f"up_{level}_block_{i}")(x, latents)
            if level < last:
                # Repeating frames after this layer gives the same result as before it, with half the work.
                x = by_frame(x, Upsample(dtype, name=f"up_{level}_upsample"))
                if level < TIME_LEVELS and x.shape[1] > 1:
                    x = _repeat(x, 2)
        x = nn.silu(CellNorm(cfg.norm_groups, name="norm_out")(x, latents))
        x = CausalConv(3 * cfg.patch_size**2, dtype, name="conv_out")(x)
        return by_frame(x, partial(depth_to_space, factor=cfg.patch_size))


def encode(config: CausalVAEConfig, params: Params, frames: Float[Array, "B T H W 3"]) -> Float[Array, "B t h w z2"]:
    """Returns the posterior's mean and log-variance of whole videos of 8k + 1 frames, piece by piece."""
    return _in_pieces(CausalEncoder(config), params["encoder"], frames, ENCODED)


def decode(config: CausalVAEConfig, params: Params, latents: Float[Array, "B t h w z"]) -> Float[Array, "B T H W 3"]:
    """Returns the frames of whole videos' latents, an odd number of latent frames, piece by piece."""
    return _in_pieces(CausalDecoder(config), params["decoder"], latents, DECODED)


def _in_pieces(network: nn.Module, params: Params, x: Video, size: int) -> Video:
    made: list[Video] = []
    state: Any = {}
    for piece in pieces(x.shape[1], size):
        out, state = network.apply({"params": params, **state}, x[:, piece], mutable=[PAST])
        made.append(out)
    return jnp.concatenate(made, axis=1)


def pieces(frames: int, size: int) -> Iterator[slice]:
    """Yields the pieces of a video, of ``size`` frames each; the first piece also has the remaining frames."""
    rest = frames % size
    for i in range(max(1, frames // size)):
        yield slice(i * size + rest * (i > 0), (i + 1) * size + rest)
