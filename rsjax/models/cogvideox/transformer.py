"""CogVideoX's transformer, which predicts the velocity from noisy latents, a text and an image.

Axes: B clips, F latent frames of h×w cells with C channels, n tokens of text with w numbers each, N tokens in all
(the text's first), S tokens of the video, D width, K heads, e channels of a head.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int, Key

from rsjax.config.data import ClipShape
from rsjax.layers.dense import Dense
from rsjax.layers.partition import gathers
from rsjax.layers.platform import attend_cells
from rsjax.models.cogvideox.config import CogVideoXConfig, latent_frames
from rsjax.models.diffusion.layers import PERIOD, TimeEmbedding, grid_positions, positions
from rsjax.trainable import Params

XAVIER = nn.initializers.xavier_uniform()
ZEROS = nn.initializers.zeros
Tokens = Float[Array, "B N D"]


@dataclass(frozen=True)
class Architecture:
    """The network's settings and the shape of a clip's latents: frames, rows and columns of cells."""

    model: CogVideoXConfig
    frames: int
    rows: int
    columns: int

    @classmethod
    def create(cls, model: CogVideoXConfig, clips: ClipShape) -> "Architecture":
        """Returns the network for clips of this shape."""
        side = clips.image_size // model.autoencoder.downsampling
        return cls(model, latent_frames(clips.frames), side, side)

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of a latent frame's tokens."""
        return self.rows // self.model.patch_size, self.columns // self.model.patch_size

    @property
    def channels(self) -> int:
        """Channels of latents, without the image's channels."""
        return self.model.autoencoder.latent_channels

    @property
    def texts(self) -> int:
        """Sets of learned tokens: for the empty text, and for each task or for all together; 0 with a text file."""
        text = self.model.text
        if text.file:
            return 0
        return 1 + max(1, len(text.tasks))


class Rotation(NamedTuple):
    """Cosines and sines of the angles by which pairs of channels are rotated; 1 and 0 for the text."""

    cos: Float32[np.ndarray, "N e2"]
    sin: Float32[np.ndarray, "N e2"]


def rotation(arch: Architecture) -> Rotation:
    """Returns the rotation for rotary positions: a quarter of a head's channels for time, then rows, then columns."""
    rows, columns = arch.grid
    across: list[np.ndarray] = [np.arange(rows), np.arange(columns)]
    if arch.model.stretch:  # as in the public sampler
        high, wide = arch.model.stretch
        size = (round(wide / columns * rows), wide)
        if rows / columns > high / wide:
            size = (high, round(high / rows * columns))
        begin = [round((whole - part) / 2) for whole, part in zip((high, wide), size, strict=True)]
        ends = [(b + s) * (n - 1) / n for b, s, n in zip(begin, size, (rows, columns), strict=True)]
        across = [np.linspace(begin[0], ends[0], rows), np.linspace(begin[1], ends[1], columns)]
    head = arch.model.width // arch.model.heads
    sizes = (head // 4, 3 * head // 8, 3 * head // 8)
    grid = (np.arange(arch.frames), *across)
    at = [x.reshape(-1, 1) for x in np.meshgrid(*grid, indexing="ij")]
    angles = [x * PERIOD ** -(np.arange(0, size, 2) / size) for x, size in zip(at, sizes, strict=True)]
    whole = np.pad(np.concatenate(angles, axis=1), ((arch.model.text.tokens, 0), (0, 0)))
    return Rotation(np.cos(whole).astype(np.float32), np.sin(whole).astype(np.float32))


def turned(x: Float[Array, "B N K e"], by: Rotation) -> Float[Array, "B N K e"]:
    """Rotates pairs of neighbouring channels."""
    first = x[..., ::2]
    second = x[..., 1::2]
    cos = by.cos[:, None]
    sin = by.sin[:, None]
    return jnp.stack([first * cos - second * sin, second * cos + first * sin], axis=-1).reshape(x.shape)


def fixed_positions(arch: Architecture) -> Float32[np.ndarray, "N D"]:
    """Returns sines and cosines: a quarter of the channels for time, the others for space; zeros for the text."""
    width = arch.model.width
    cells = int(np.prod(arch.grid))
    time = np.repeat(positions(arch.frames, width // 4), cells, axis=0)
    space = np.tile(grid_positions(*arch.grid, 3 * width // 4, arch.model.position_scale), (arch.frames, 1))
    return np.pad(np.concatenate([time, space], axis=1), ((arch.model.text.tokens, 0), (0, 0)))


def _norm(name: str, epsilon: float = 1e-5) -> nn.LayerNorm:
    return nn.LayerNorm(epsilon=epsilon, use_fast_variance=False, name=name)


class CogVideoXBlock(nn.Module):
    """Attention among all tokens, then an MLP. The step shifts, scales and gates text and video separately."""

    arch: Architecture

    @nn.compact
    def __call__(self, x: Tokens, time: Float[Array, "B E"]) -> tuple[Tokens, None]:
        cfg = self.arch.model
        dense = partial(Dense, bf16=cfg.compute_dtype == "bfloat16", kernel_init=XAVIER)
        h, gate = self._modulated("norm1", x, time)
        q, k, v = (dense(cfg.width, name=f"to_{name}")(h).reshape(*x.shape[:2], cfg.heads, -1) for name in "qkv")
        q = _norm("norm_q", 1e-6)(q)
        k = _norm("norm_k", 1e-6)(k)
        if cfg.positions == "rotary":
            by = rotation(self.arch)
            q = turned(q, by)
            k = turned(k, by)
        out = attend_cells(q[:, None], k[:, None], v[:, None], cfg.compute_dtype == "bfloat16")
        x = x + gate * dense(cfg.width, name="to_out")(out.reshape(x.shape))
        h, gate = self._modulated("norm2", x, time)
        hidden = nn.gelu(dense(cfg.mlp_ratio * cfg.width, name="fc1")(h), approximate=True)
        return x + gate * dense(cfg.width, name="fc2")(hidden), None

    def _modulated(self, name: str, x: Tokens, time: Float[Array, "B E"]) -> tuple[Tokens, Tokens]:
        """Returns the normalised x, shifted and scaled, and the gates."""
        cfg = self.arch.model
        parts = nn.Dense(6 * cfg.width, kernel_init=ZEROS, name=f"{name}_linear")(nn.silu(time))[:, None]
        video, text = jnp.split(parts, 2, axis=-1)
        is_text = (np.arange(x.shape[1]) < cfg.text.tokens)[:, None]
        pairs = zip(jnp.split(text, 3, axis=-1), jnp.split(video, 3, axis=-1), strict=True)
        shift, scale, gate = (jnp.where(is_text, *pair) for pair in pairs)
        return _norm(name)(x) * (1 + scale) + shift, gate


class Transformer(nn.Module):
    """The network."""

    arch: Architecture

    @nn.compact
    def __call__(
        self,
        latents: Float[Array, "B F h w C"],
        t: Int[Array, " B"],
        text: Float[Array, "B n w"] | Int[Array, " B"],
        image: Float[Array, "B h w C"] | None = None,
    ) -> Float[Array, "B F h w C"]:
        """Returns the velocity of latents at step ``t``.

        Args:
            latents: noisy latents.
            text: embeddings, or numbers of learned ones: 0 is the empty text.
            image: the latents of the image, for the image's channels; None if the network has none.
        """
        arch = self.arch
        cfg = arch.model
        if latents.shape[1:] != (arch.frames, arch.rows, arch.columns, arch.channels):
            raise ValueError(f"latents are {latents.shape[1:]}, not of {arch.frames}×{arch.rows}×{arch.columns} cells")
        if arch.texts:
            shape = (arch.texts, cfg.text.tokens, cfg.text.width)
            text = self.param("task_tokens", nn.initializers.normal(1.0), shape)[text]
        text = nn.Dense(cfg.width, kernel_init=XAVIER, name="text_proj")(text)
        if cfg.image == "channels":
            known = jnp.zeros_like(latents)
            if image is not None:
                known = known.at[:, 0].set(image)
            latents = jnp.concatenate([latents, known], axis=-1)
        patch = (cfg.patch_size, cfg.patch_size)
        x = nn.Conv(cfg.width, patch, patch, "VALID", kernel_init=XAVIER, name="patches")(latents)
        x = jnp.concatenate([text, x.reshape(len(x), -1, cfg.width)], axis=1)
        if cfg.positions == "sincos":
            x = x + fixed_positions(arch)
        if cfg.learned_positions:
            x = x + self.param("learned_positions", ZEROS, x.shape[1:])
        time = TimeEmbedding(cfg.time_width, cfg.width, name="time")(t)
        block = gathers(CogVideoXBlock)
        if cfg.remat == "blocks":
            block = nn.remat(block, prevent_cse=cfg.unroll > 1)
        scan = nn.scan(
            block,
            variable_axes={"params": 0},
            split_rngs={"params": True},
            in_axes=nn.broadcast,
            length=cfg.blocks,
            unroll=min(cfg.unroll, cfg.blocks),
            check_constancy_invariants=False,  # else, the blocks are traced twice
        )
        x, _ = scan(arch, name="blocks")(x, time)
        x = _norm("norm_final")(x[:, cfg.text.tokens :])
        ada = nn.Dense(2 * cfg.width, kernel_init=ZEROS, name="norm_out_linear")(nn.silu(time))[:, None]
        shift, scale = jnp.split(ada, 2, axis=-1)
        x = _norm("norm_out")(x) * (1 + scale) + shift
        x = nn.Dense(cfg.patch_size**2 * arch.channels, kernel_init=ZEROS, name="proj_out")(x)
        x = x.reshape(len(x), arch.frames, *arch.grid, arch.channels, cfg.patch_size, cfg.patch_size)
        x = x.transpose(0, 1, 2, 5, 3, 6, 4)
        return x.reshape(len(x), arch.frames, arch.rows, arch.columns, arch.channels)

    def init_params(self, key: Key[Array, ""]) -> Params:
        """Returns initial parameters, with which the network predicts zeros."""
        arch = self.arch
        text = self.arch.model.text
        latents = jnp.zeros((1, arch.frames, arch.rows, arch.columns, arch.channels))
        shown: Any = jnp.zeros((1, text.tokens, text.width))
        if arch.texts:
            shown = jnp.zeros(1, jnp.int32)
        return self.init(key, latents, jnp.zeros(1, jnp.int32), shown)["params"]


def shapes(arch: Architecture) -> Params:
    """Returns the shapes of the network's parameters."""
    return jax.eval_shape(Transformer(arch).init_params, jax.random.key(0))


def forward_flops(arch: Architecture) -> int:
    """Returns the floating-point operations of one pass over a clip: its matrix products, 2·m·n·k each."""
    cfg = arch.model
    width = arch.model.width
    video = arch.frames * int(np.prod(arch.grid))
    tokens = cfg.text.tokens + video
    block = tokens * ((4 + 2 * cfg.mlp_ratio) * width + 2 * tokens) * width + 12 * cfg.time_width * width
    patch = cfg.patch_size**2 * arch.channels
    patches = 3 if cfg.image == "channels" else 2  # of latents at both ends, and of the image
    ends = video * patch * width * patches + cfg.text.tokens * cfg.text.width * width
    time = cfg.time_width * (width + cfg.time_width) + 2 * cfg.time_width * width
    return 2 * (cfg.blocks * block + ends + time)
