"""Trains iVideoGPT's tokenizer, and encodes and decodes videos with the trained one.

The public code adds a discriminator at 256² pixels after 250,000 steps, and crops and recolours clips; this code does
neither.

Axes: B clips, T frames of which the first c are context, F = T - c, g×g cells, n tokens of a later frame.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from jaxtyping import Array, Bool, Key

from rsjax.clip import Video
from rsjax.config import Config, TokenizerTrainConfig, require
from rsjax.data.codec import Record
from rsjax.data.loader import Arrays, Transform
from rsjax.data.normalization import Normalization
from rsjax.devices import divide
from rsjax.errors import UserError
from rsjax.models.ivideogpt.conditional_vq import ConditionalVQ, Reconstruction
from rsjax.models.ivideogpt.config import ConditionalVQConfig, IVideoGPTConfig
from rsjax.models.network_settings import check_alike, read_model, saved_inputs
from rsjax.tokenizers.autoencoder import Autoencoder
from rsjax.tokenizers.codec import each_pass, images_per_pass
from rsjax.tokenizers.flops import traced_flops
from rsjax.tokenizers.lpips import lpips
from rsjax.tokenizers.training import lpips_weights, require_no_adversarial
from rsjax.trainable import Extra, Params, StepContext, Term

Batch = dict[str, Any]  # frames 0–255 (B, T, H, W, 3) and index (B,), which determines a clip's dropout


@dataclass(frozen=True)
class ConditionalVQTraining(Autoencoder[Batch]):
    """Trains the tokenizer to reconstruct the first frames of a clip and some later frames."""

    config: ConditionalVQConfig
    train: TokenizerTrainConfig
    image_size: int

    def __post_init__(self) -> None:
        require(
            self.train.frames_per_clip > self.config.context_frames,
            f"tokenizer_train.frames_per_clip is {self.train.frames_per_clip}; the tokenizer learns from "
            f"model.autoencoder.context_frames {self.config.context_frames} and at least one later frame",
        )
        require_no_adversarial(self.train, "iVideoGPT's tokenizer")

    @classmethod
    def create(cls, config: Config) -> "ConditionalVQTraining":
        """Returns the training of a configuration's autoencoder."""
        assert isinstance(config.model, IVideoGPTConfig)
        return cls(config.model.autoencoder, config.tokenizer_train, config.clips.image_size)

    @property
    def loss_weights(self) -> dict[str, float]:
        weights = self.train.loss_weights
        used = {name: weights.get(name) for name in ("l1", "l2", "perceptual", "commitment")}
        return {name: weight for name, weight in used.items() if weight} | {"codebook": self.config.codebook_weight}

    def init(self, key: Key[Array, ""]) -> Params:
        return ConditionalVQ(self.config).init_params(key, self.image_size)

    def init_extra(self) -> Extra:
        if "perceptual" not in self.loss_weights:
            return None
        return {"lpips": lpips_weights(self.train, self.image_size)}

    def loss_terms(self, params: Params, batch: Batch, key: Key[Array, ""], context: StepContext) -> dict[str, Term]:
        """Returns the terms; those of pixels are the mean over context frames plus the mean over later frames."""
        frames = jnp.asarray(batch["frames"], jnp.float32) / 255
        first = self.config.context_frames
        inputs = ({"params": params}, frames, batch["index"])
        made = cast(Reconstruction, ConditionalVQ(self.config).apply(*inputs, rngs={"dropout": key}))
        pairs = ((frames[:, :first], made.context), (frames[:, first:], made.future))

        def total(distance: Callable[[Array, Array], Array]) -> Array:
            return jnp.mean(distance(*pairs[0])) + jnp.mean(distance(*pairs[1]))

        terms = {
            "l1": total(lambda one, other: jnp.abs(one - other)),
            "l2": total(lambda one, other: jnp.square(one - other)),
            "codebook": made.codebook,
            "commitment": made.commitment,
        }
        if "perceptual" in self.loss_weights:
            weights = cast(dict[str, Any], context.extra)["lpips"]
            terms["perceptual"] = total(lambda one, other: lpips(weights, 2 * one - 1, 2 * other - 1))
        count = jnp.float32(len(frames))
        return {name: (terms[name] * count, count) for name in self.loss_weights}

    def transform(self) -> Transform:
        return partial(_draw, self.config.context_frames, self.train.frames_per_clip, self.train.flip)

    def batch(self, arrays: Arrays) -> Batch:
        return {name: arrays[name] for name in ("frames", "index")}

    def codec(self, params: Params, normalization: Normalization) -> "ConditionalCodec":
        return ConditionalCodec(self.config, params)

    def flops(self) -> dict[str, int]:
        count = self.train.frames_per_clip
        # Products of bf16 operands multiply padding too.
        network = ConditionalVQ(replace(self.config, compute_dtype="float32"))

        def encode(params: Params, frames: Any) -> Any:
            return network.apply({"params": params}, frames, method="encode")

        def decode(params: Params, tokens: Any) -> Any:
            return network.apply({"params": params}, *tokens, method="decode")

        whole = traced_flops(self.shapes(), (1, count, self.image_size, self.image_size, 3), encode, decode)
        return {half: number // count for half, number in whole.items()}

    def pretrained_shapes(self, directory: Path) -> Params:
        """Returns the shapes of saved weights, whose network has at least as many context frames as this one.

        Raises:
            UserError: the weights are missing or of another network; the message names the differing fields.
        """
        saved = read_model(directory, IVideoGPTConfig, "tokenizer").autoencoder
        free = {"dropout", "codebook_scale", "codebook_weight", "compute_dtype"}
        if saved.context_frames >= self.config.context_frames:
            free.add("context_frames")
        check_alike(directory, saved, self.config, free, "model.autoencoder")
        if (size := saved_inputs(directory).image_size) != self.image_size:
            raise UserError(f"{directory}: its tokenizer is for images of {size} pixels, these have {self.image_size}")
        return ConditionalVQTraining(saved, TokenizerTrainConfig(frames_per_clip=99), self.image_size).shapes()

    def start(self, fresh: Params, saved: Params, directory: Path) -> Params:
        """Returns the saved parameters; of more context frames, keeps the last positions, as the public code does."""
        own = flatten_dict(fresh)
        params = flatten_dict(saved)
        return unflatten_dict({path: x[-own[path].shape[0] :] if x.ndim else x for path, x in params.items()})


def _draw(context: int, count: int, flip: bool, record: Record, rng: np.random.Generator) -> Arrays:
    """Returns ``frames``, ``count`` in all: a clip's first ``context`` frames and random later frames, in order."""
    rgb = record["rgb"]
    later = np.arange(context, len(rgb))
    drawn = np.sort(rng.choice(later, count - context, replace=count - context > len(later)))
    frames = rgb[np.concatenate([np.arange(context), drawn])]
    if flip and rng.random() < 0.5:
        frames = np.ascontiguousarray(frames[:, :, ::-1])
    return {"frames": frames}


@dataclass(frozen=True)
class ConditionalCodec:
    """A trained tokenizer that takes and returns numpy arrays."""

    config: ConditionalVQConfig
    params: Params

    def encode(self, video: Video) -> dict[str, np.ndarray]:
        """Returns tokens: "context" of the first c frames, (B, c, g, g), and "future" of the others, (B, F, n).

        If the video has fewer than c frames, its first frame is repeated at the beginning.
        """
        lacking = max(0, self.config.context_frames - video.rgb.shape[1])
        frames = np.concatenate([np.repeat(video.rgb[:, :1], lacking, 1), video.rgb], axis=1)
        alone = frames.shape[1] == self.config.context_frames
        if alone:  # a placeholder for the later frame that the network needs
            frames = np.concatenate([frames, frames[:, -1:]], axis=1)
        context, future = self._chunked("encode", frames.shape[2], frames)
        return {"context": context, "future": future[:, : future.shape[1] - alone]}

    def decode(self, tokens: dict[str, Any], has_depth: Bool[np.ndarray, " B"] | None = None) -> Video:
        """Decodes tokens to frames; there is no depth."""
        context, future = (np.asarray(tokens[name]) for name in ("context", "future"))
        alone = future.shape[1] == 0  # if there are no later frames, a placeholder is decoded
        if alone:
            future = np.zeros((len(future), 1, future.shape[2]), np.int32)
        (frames,) = self._chunked("decode", context.shape[2] * self.config.downsampling, context, future)
        return Video(frames[:, : frames.shape[1] - alone])

    def _chunked(self, method: Literal["encode", "decode"], side: int, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        """Applies the network to a power of two of clips at a time; their images have ``side`` pixels a side."""
        total = len(arrays[0])
        frames = sum(x.shape[1] for x in arrays)
        most = max(1, images_per_pass(side) // frames)
        size = min(2 ** (total - 1).bit_length(), 2 ** (most.bit_length() - 1))

        def run(start: int) -> list[np.ndarray]:
            chunk = [x[start : start + size] for x in arrays]
            padded = [np.concatenate([x, np.repeat(x[-1:], size - len(x), axis=0)]) for x in chunk]
            made = _apply(self.config, method, self.params, *divide(padded, self.params))
            return [np.asarray(x)[: len(chunk[0])] for x in made]

        parts = each_pass(run, range(0, total, size))
        return tuple(np.concatenate(same) for same in zip(*parts, strict=True))


@partial(jax.jit, static_argnums=(0, 1))
def _apply(config: ConditionalVQConfig, method: str, params: Params, *arrays: Array) -> tuple[Array, ...]:
    made: Any = ConditionalVQ(config).apply({"params": params}, *arrays, method=method)
    if method == "decode":
        return (jnp.round(made).astype(jnp.uint8),)
    return made
