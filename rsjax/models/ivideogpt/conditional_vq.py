"""The conditional VQ tokenizer of iVideoGPT: context frames have many tokens, later frames few.

A later frame is encoded and decoded with cross-attention to the features of the context, so its tokens only have to
describe what has changed. Submodules are named after the public checkpoints' keys.

Axes: B clips, c context frames, F later frames, N = B·c or B·F images, H×W pixels, g×g cells, n tokens of a later
frame, C channels.
"""

from collections.abc import Callable
from itertools import count
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rsjax.layers.group_norm import GroupNorm
from rsjax.models.ivideogpt.config import ConditionalVQConfig
from rsjax.tokenizers.magvit2 import depth_to_space, space_to_depth
from rsjax.tokenizers.vae_blocks import Map, decode, encode

Features = list[Float[Array, "B c h w C"]]  # of the context after each level
Index = Int[Array, " B"] | None  # each clip's number, which decides its dropout; None: no dropout
Dropout = Callable[[Float[Array, "B ..."], Any], Float[Array, "B ..."]]  # (values, number of the draw) → values

UNROLLED = 16  # frames whose code is written out; more take longer to compile


class CrossAttention(nn.Module):
    """Lets every cell of a later frame attend to all cells of its clip's context frames."""

    config: ConditionalVQConfig

    @nn.compact
    def __call__(self, z: Map, context: Float[Array, "B c h w C"], index: Index) -> Map:
        cfg = self.config
        clips, frames, h, w, width = context.shape
        # Context frames are stacked along the height before the norm, as in the public code.
        kv = GroupNorm(cfg.norm_groups, 1e-5, name="kv_norm")(context.reshape(clips, frames * h, w, width))
        kv = kv.reshape(clips, -1, width) + self.param("kv_pos_emb", nn.initializers.zeros, (frames * h * w, width))
        q = GroupNorm(cfg.norm_groups, 1e-5, name="q_norm")(z).reshape(clips, -1, h * w, width)
        q = q + self.param("q_pos_emb", nn.initializers.zeros, (h * w, width))
        kernel = self.param("in_proj_kernel", nn.initializers.xavier_uniform(), (width, 3 * width))
        bias = self.param("in_proj_bias", nn.initializers.zeros, (3 * width,))
        heads = lambda x: x.reshape(*x.shape[:-1], cfg.heads, width // cfg.heads).swapaxes(-3, -2)  # noqa: E731
        q = heads(q @ kernel[:, :width] + bias[:width])
        k, v = map(heads, jnp.split(kv @ kernel[:, width:] + bias[width:], 2, axis=-1))
        drop = self._dropout(index)
        out = _attend(q, k, v, drop).swapaxes(2, 3).reshape(clips, -1, h * w, width)
        return nn.silu(z + drop(nn.Dense(width, name="out_proj")(out), 0).reshape(z.shape))

    def _dropout(self, index: Index) -> Dropout:
        """Returns dropout by the clip's number, so that a step does not depend on how its batch is split."""
        if index is None or not self.config.dropout:
            return lambda x, draw: x
        key = self.make_rng("dropout")
        share = 1 - self.config.dropout

        def drop(x: Float[Array, "B ..."], draw: Any) -> Float[Array, "B ..."]:
            def kept(number: Int[Array, ""]) -> Bool[Array, "..."]:
                return jax.random.bernoulli(jax.random.fold_in(keys, number), share, x.shape[1:])

            keys = jax.random.fold_in(key, draw)
            return jnp.where(jax.vmap(kept)(index), x / share, 0.0)

        return drop


def _attend(
    q: Float[Array, "B F H q e"], k: Float[Array, "B H k e"], v: Float[Array, "B H k e"], drop: Dropout
) -> Float[Array, "B F H q e"]:
    """Returns softmax(q·kᵀ/√e)·v with dropout of the weights, for one later frame after another.

    A frame's scores stay in the processor's cache, and the loop is unrolled so that XLA runs several frames at the same
    time; with the gradient, this takes a third to a half of the time of all frames at once.
    """

    def one(_: None, frame: tuple[Float[Array, "B H q e"], Int[Array, ""]]) -> tuple[None, Float[Array, "B H q e"]]:
        q, number = frame
        scores = jnp.einsum("bhqe,bhke->bhqk", q, k)
        weights = jnp.exp(scores - jax.lax.stop_gradient(scores.max(-1, keepdims=True)))
        return None, jnp.einsum("bhqk,bhke->bhqe", drop(weights, number), v) / weights.sum(-1, keepdims=True)

    frames = jnp.moveaxis(q * q.shape[-1] ** -0.5, 1, 0)
    made = jax.lax.scan(one, None, (frames, 1 + jnp.arange(len(frames))), unroll=min(len(frames), UNROLLED))[1]
    return jnp.moveaxis(made, 0, 1)


class ConditionalEncoder(nn.Module):
    """Maps images in [0, 1] to latents; later frames need the features of the ``context``."""

    config: ConditionalVQConfig

    @nn.compact
    def __call__(
        self, images: Float[Array, "N H W 3"], context: Features | None = None, index: Index = None
    ) -> tuple[Map, list[Map]]:
        """Returns the latents (N, g, g, latent), and the features after each level."""
        cfg = self.config
        features = list[Map]()
        x = space_to_depth(images, cfg.patch_size)
        after = _crossing(cfg, context, index, features)
        sizes = (cfg.widths, cfg.res_blocks, cfg.norm_groups, cfg.latent)
        return encode(x, *sizes, context is not None, cfg.compute_dtype, after), features


class ConditionalDecoder(nn.Module):
    """Maps latents to images in about [0, 1] (not clipped); later frames need the features of the ``context``."""

    config: ConditionalVQConfig

    @nn.compact
    def __call__(
        self, latents: Map, context: Features | None = None, index: Index = None
    ) -> tuple[Float[Array, "N H W 3"], list[Map]]:
        """Returns images, and the features after the middle and each level."""
        cfg = self.config
        features = list[Map]()
        after = _crossing(cfg, context, index, features)
        sizes = (cfg.widths, cfg.res_blocks, cfg.norm_groups, 3 * cfg.patch_size**2)
        x = decode(latents, *sizes, context is not None, cfg.compute_dtype, after)
        return depth_to_space(x, cfg.patch_size), features


def _crossing(
    config: ConditionalVQConfig, context: Features | None, index: Index, features: list[Map]
) -> Callable[[Map], Map]:
    """Returns the function after each level: attention to the context if the grid is small; adds to ``features``."""
    crossed = count()

    def after(x: Map) -> Map:
        if context is not None and x.shape[-2] <= config.attention_size:
            x = CrossAttention(config, name=f"cross_{next(crossed)}")(x, context[len(features)], index)
        features.append(x)
        return x

    return after


class Codebook(nn.Module):
    """Vector quantisation: the nearest of a learned set of vectors."""

    config: ConditionalVQConfig

    def setup(self) -> None:
        cfg = self.config
        scale = cfg.codebook_scale or 1 / cfg.codes
        draw = nn.initializers.uniform(2 * scale)
        self.embedding = self.param("embedding", lambda *args: draw(*args) - scale, (cfg.codes, cfg.latent))

    def nearest(self, z: Float[Array, "*N D"]) -> Int[Array, "*N"]:
        """Returns the number of the nearest vector."""
        distances = jnp.sum(jnp.square(self.embedding), -1) - 2 * z @ self.embedding.T  # + |z|², the same for all
        return jnp.argmin(distances, axis=-1).astype(jnp.int32)

    def __call__(self, z: Float[Array, "*N D"]) -> tuple[Float[Array, "*N D"], Float[Array, ""], Float[Array, ""]]:
        """Returns the nearest vectors with the straight-through gradient, and the losses of codebook and commitment."""
        near = self.lookup(self.nearest(z))
        codebook = jnp.mean(jnp.square(near - jax.lax.stop_gradient(z)))
        commitment = jnp.mean(jnp.square(jax.lax.stop_gradient(near) - z))
        return z + jax.lax.stop_gradient(near - z), codebook, commitment

    def lookup(self, tokens: Int[Array, "*N"]) -> Float[Array, "*N D"]:
        """Returns the vectors of these numbers; a number beyond the codebook counts as its last."""
        return self.embedding[jnp.clip(tokens, 0, self.config.codes - 1)]


class Reconstruction(NamedTuple):
    """The output of a training pass: images in about [0, 1], and the summed losses of both codebooks."""

    context: Float[Array, "B c H W 3"]
    future: Float[Array, "B F H W 3"]
    codebook: Float[Array, ""]
    commitment: Float[Array, ""]


class ConditionalVQ(nn.Module):
    """Both encoders, codebooks and decoders; ``apply`` takes ``method`` "encode", "decode" or neither."""

    config: ConditionalVQConfig

    def setup(self) -> None:
        cfg = self.config
        self.encoder = ConditionalEncoder(cfg)
        self.cond_encoder = ConditionalEncoder(cfg)
        self.decoder = ConditionalDecoder(cfg)
        self.cond_decoder = ConditionalDecoder(cfg)
        self.quant_conv, self.post_quant_conv = (nn.Conv(cfg.latent, (1, 1)) for _ in range(2))
        self.quant_linear = nn.Dense(cfg.latent)
        self.post_quant_linear = nn.Dense(cfg.latent * cfg.future_patch**2)
        self.quantize = Codebook(cfg)
        self.dynamics_quantize = Codebook(cfg)

    def __call__(self, frames: Float[Array, "B T H W 3"], index: Index = None) -> Reconstruction:
        """Encodes and decodes clips in [0, 1], differentiable through the codebooks."""
        context, future = self._latents(frames, index)
        context, *of_context = self.quantize(context)
        future, *of_future = self.dynamics_quantize(future)
        images = self._images(context, future, index)
        codebook, commitment = (one + other for one, other in zip(of_context, of_future, strict=True))
        return Reconstruction(images[0], images[1], codebook, commitment)

    def encode(self, frames: Float[Array, "B T H W 3"]) -> tuple[Int[Array, "B c g g"], Int[Array, "B F n"]]:
        """Returns the tokens of the first c frames and of the later ones, of images 0–255."""
        context, future = self._latents(jnp.asarray(frames, jnp.float32) / 255)
        return self.quantize.nearest(context), self.dynamics_quantize.nearest(future)

    def decode(self, context: Int[Array, "B c g g"], future: Int[Array, "B F n"]) -> Float[Array, "B T H W 3"]:
        """Decodes tokens to images 0–255 (float32, clipped, not rounded)."""
        images = self._images(self.quantize.lookup(context), self.dynamics_quantize.lookup(future))
        return jnp.clip(jnp.concatenate(images, axis=1), 0.0, 1.0) * 255

    def _latents(
        self, frames: Float[Array, "B T H W 3"], index: Index = None
    ) -> tuple[Float[Array, "B c g g D"], Float[Array, "B F n D"]]:
        cfg = self.config
        context, future = jnp.split(frames, [cfg.context_frames], axis=1)
        h, features = self.encoder(_flat(context))
        d, _ = self.cond_encoder(_flat(future), _by_clip(features, context), index)
        d = space_to_depth(d, cfg.future_patch)
        d = self.quant_linear(d.reshape(*future.shape[:2], -1, d.shape[-1]))
        h = self.quant_conv(h)
        return h.reshape(*context.shape[:2], *h.shape[1:]), d

    def _images(
        self, context: Float[Array, "B c g g D"], future: Float[Array, "B F n D"], index: Index = None
    ) -> tuple[Float[Array, "B c H W 3"], Float[Array, "B F H W 3"]]:
        cfg = self.config
        patches = context.shape[2] // cfg.future_patch
        first, features = self.decoder(self.post_quant_conv(_flat(context)))
        d = self.post_quant_linear(future)
        d = depth_to_space(d.reshape(-1, patches, patches, d.shape[-1]), cfg.future_patch)
        later, _ = self.cond_decoder(d, _by_clip(features, context), index)
        return first.reshape(*context.shape[:2], *first.shape[1:]), later.reshape(*future.shape[:2], *later.shape[1:])

    def init_params(self, key: Array, image_size: int) -> dict[str, Array]:
        """Returns fresh parameters for images of this size, on which the learned positions depend."""
        frames = jnp.zeros((1, self.config.context_frames + 1, image_size, image_size, 3))
        return self.init(key, frames)["params"]


def _flat(x: Float[Array, "B F ..."]) -> Float[Array, "N ..."]:
    return x.reshape(-1, *x.shape[2:])


def _by_clip(features: list[Map], context: Float[Array, "B c ..."]) -> Features:
    return [x.reshape(*context.shape[:2], *x.shape[1:]) for x in features]
