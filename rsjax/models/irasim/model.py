"""The IRASim family: the transformer with its autoencoder, loss and sampler, behind the interface of world models.

With ``model.autoencoder.depth`` the same transformer denoises RGB and depth together, as channels of one latent.

Axes: B clips, T frames, P prompt frames, h×w cells of latents with C channels, A action inputs.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from rsjax.clip import Video
from rsjax.config import ClipShape, Config
from rsjax.data.codec import Record
from rsjax.data.loader import Arrays, Transform
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store
from rsjax.models.base import Assets, WorldModel, implements
from rsjax.models.diffusion.schedule import add_noise, target
from rsjax.models.irasim import pretrained
from rsjax.models.irasim.autoencoder import KLCodec, KLTraining
from rsjax.models.irasim.config import IRASimConfig
from rsjax.models.irasim.dit import Architecture, DiT, architecture, forward_flops
from rsjax.models.irasim.rollout import rollout
from rsjax.tokenizers.tokenize import described, prepare_store
from rsjax.trainable import Params, StepContext, Term

Batch = dict[str, Any]  # latents (B, T, h, w, C), actions (B, T, A), weight, index and (with depth) has_depth (B,)


@implements(IRASimConfig)
@dataclass(frozen=True)
class IRASim(WorldModel[Batch]):
    """The latent video diffusion transformer.

    Attributes:
        config: the family's settings.
        architecture: the network's settings.
        prompt_frames: frames that are free of noise in training and form the prompt in generation.
        clips: the shape of the training clips.
    """

    config: IRASimConfig
    architecture: Architecture
    prompt_frames: int
    clips: ClipShape

    @classmethod
    def create(cls, config: Config) -> "IRASim":
        assert isinstance(config.model, IRASimConfig)
        return cls(config.model, architecture(config), config.prompt_frames, config.clips)

    @classmethod
    def autoencoder(cls, config: Config) -> KLTraining:
        return KLTraining.create(config)

    @property
    def loss_weights(self) -> dict[str, float]:
        return self.config.loss_weights

    def init(self, key: Key[Array, ""]) -> Params:
        return DiT(self.architecture).init_params(key)

    def loss_terms(self, params: Params, batch: Batch, key: Key[Array, ""], context: StepContext) -> dict[str, Term]:
        """Returns "error": the mean squared error of the predicted noise over the frames after the prompt.

        With depth, "error" is that of RGB's channels, and "depth" that of depth's, over the clips that have it.
        """
        noise = self.config.noise
        latents = batch["latents"]
        past = self.prompt_frames

        def draw(index: Int[Array, ""]) -> tuple[Array, Array, Array]:
            t_key, noise_key, drop_key = jax.random.split(jax.random.fold_in(key, index), 3)
            t = jax.random.randint(t_key, (), 0, noise.steps)
            dropped = jax.random.bernoulli(drop_key, self.config.action_dropout)
            return t, jax.random.normal(noise_key, latents.shape[1:]), dropped

        t, drawn, drop = jax.vmap(draw)(batch["index"])
        noisy = add_noise(noise, latents, drawn, t).at[:, :past].set(latents[:, :past])
        predicted: Any = DiT(self.architecture).apply({"params": params}, noisy, t, batch["actions"], drop)
        error = jnp.square(predicted - target(noise, latents, drawn, t))[:, past:]
        weight = batch["weight"].astype(jnp.float32)

        def term(error: Array, weight: Float[Array, " B"]) -> Term:
            return jnp.sum(weight * jnp.mean(error, axis=(1, 2, 3, 4))), jnp.sum(weight)

        if not self.config.uses_depth:
            return {"error": term(error, weight)}
        z = self.architecture.channels
        terms = {"error": term(error[..., :z], weight), "depth": term(error[..., z:], weight * batch["has_depth"])}
        return {name: terms[name] for name in self.loss_weights}

    def prepare(self, clips: Store, assets: Assets, folder: Path, max_damaged: float) -> Store:
        """Encodes every clip; stores the latents beside the clips for all runs with this autoencoder."""
        codec = self._codec(assets)

        def encode(clip: Record) -> Record:
            depth = clip["depth"]
            video = Video(clip["rgb"][None], None if depth is None else depth[None])
            latents = codec.encode(video)
            record = {name: x[0].astype(np.float16) for name, x in latents.items()} | described(clip)
            if self.config.uses_depth:
                record["has_depth"] = bool(video.has_depth[0])
            return record

        size = self.clips.image_size
        return prepare_store(clips, codec.config, codec.params, encode, size, folder, max_damaged)

    def transform(self, normalization: Normalization) -> Transform:
        return partial(latent_arrays, normalization, self.config.integrate_actions)

    def example(self, rng: np.random.Generator) -> Record:
        arch = self.architecture
        shape = (arch.frames, arch.rows, arch.columns, arch.inputs)
        record = {
            "mean": rng.normal(size=shape).astype(np.float16),
            "deviation": np.full(shape, 0.1, np.float16),
            "actions": rng.normal(size=(arch.frames, self.clips.action_dim)).astype(np.float32),
        }
        if arch.depth:
            record["has_depth"] = True
        return record

    def generate(
        self,
        params: Params,
        assets: Assets,
        prompt: Video,
        actions: Float[np.ndarray, "B T A"],
        *,
        index: Int[np.ndarray, " B"] | None = None,
        depth: bool = True,
    ) -> Video:
        codec = self._codec(assets)
        numbers = np.arange(len(actions)) if index is None else np.asarray(index)
        known = codec.encode(prompt)["mean"]
        inputs = assets.normalization.action_inputs(actions, False)
        made = rollout(self.architecture, self.config, self.prompt_frames, params, known, inputs, numbers)
        return codec.decode({"mean": made}, prompt.has_depth & depth)

    def reconstruct(self, assets: Assets, video: Video) -> Video:
        codec = self._codec(assets)
        return codec.decode(codec.encode(video), video.has_depth)

    def pretrained_shapes(self, directory: Path) -> Params:
        saved = pretrained.check_network(directory, self.architecture)
        return jax.eval_shape(DiT(saved).init_params, jax.random.key(0))

    def start(self, fresh: Params, saved: Params, directory: Path) -> Params:
        return pretrained.completed(fresh, saved, self.architecture)

    def flops(self, frames: int) -> dict[str, int]:
        forward = forward_flops(self.architecture)
        return {"forward": forward, "train": 3 * forward}

    def _codec(self, assets: Assets) -> KLCodec:
        assert assets.tokenizer is not None
        return KLCodec(self.config.autoencoder, assets.tokenizer, assets.normalization)


def latent_arrays(normalization: Normalization, integrate: bool, record: Record, rng: np.random.Generator) -> Arrays:
    """Returns a sample of a record's posterior, the network's inputs from its actions, and whether it has depth."""
    mean, deviation = (record[name].astype(np.float32) for name in ("mean", "deviation"))
    drawn = rng.standard_normal(mean.shape, np.float32)
    arrays = {
        "latents": mean + deviation * drawn,
        "actions": normalization.action_inputs(record["actions"], integrate),
    }
    if "has_depth" in record:
        arrays["has_depth"] = np.asarray(record["has_depth"], np.float32)
    return arrays
