"""The iVideoGPT family: makes the clips' tokens, computes the next token's cross-entropy, and generates videos.

Axes: B clips, T frames of which the first c are context, A action dimensions, L tokens of a clip's sequence.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, Key

from rsjax.clip import Video
from rsjax.config import ClipShape, Config
from rsjax.data.codec import Record
from rsjax.data.loader import Arrays, Transform
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.models.base import Assets, WorldModel, implements
from rsjax.models.ivideogpt.autoencoder import ConditionalCodec, ConditionalVQTraining
from rsjax.models.ivideogpt.config import IVideoGPTConfig
from rsjax.models.ivideogpt.llama import Architecture, LLaMA, empty_cache, folded
from rsjax.models.ivideogpt.rollout import generate
from rsjax.models.ivideogpt.sequence import Layout
from rsjax.models.network_settings import check_alike, read_model, saved_inputs
from rsjax.tokenizers.autoencoder import Autoencoder
from rsjax.tokenizers.tokenize import described, prepare_store
from rsjax.trainable import Params, StepContext, Term

FREE = {"autoencoder", "positions", "use_actions", "integrate_actions", "dropout", "compute_dtype", "sample"}
FREE |= {"unroll", "remat"}  # neither changes the parameters


@implements(IVideoGPTConfig)
@dataclass(frozen=True)
class IVideoGPT(WorldModel[dict[str, Array]]):
    """The LLaMA on the tokens of the conditional VQ tokenizer.

    Attributes:
        config: the family's settings.
        clips: the shape of the training clips.
    """

    config: IVideoGPTConfig
    clips: ClipShape

    @classmethod
    def create(cls, config: Config) -> "IVideoGPT":
        assert isinstance(config.model, IVideoGPTConfig)
        return cls(config.model, config.clips)

    @classmethod
    def autoencoder(cls, config: Config) -> Autoencoder[Any]:
        return ConditionalVQTraining.create(config)

    @property
    def loss_weights(self) -> dict[str, float]:
        return self.config.loss_weights

    @property
    def architecture(self) -> Architecture:
        """The network's settings."""
        return Architecture.create(self.config, self.clips)

    def init(self, key: Key[Array, ""]) -> Params:
        return LLaMA(self.architecture).init_params(key)

    def loss_terms(
        self, params: Params, batch: dict[str, Array], key: Key[Array, ""], context: StepContext
    ) -> dict[str, Term]:
        """Returns the cross-entropy of all numbers after the first slot, including later slots, in nats.

        Each clip's index determines its dropout, also in validation, so that a step gives the same result however the
        batch is split over devices.
        """
        arch = self.architecture
        tokens = batch["tokens"]
        index = batch["index"]
        keys = None
        if self.config.dropout:
            keys = folded(jnp.broadcast_to(key, index.shape), index)
        first = arch.layout.first_slot
        inputs = (tokens[:, :-1], batch["actions"])
        logits, _ = LLaMA(arch).apply({"params": params}, *inputs, keys=keys, skip=first)
        error = optax.softmax_cross_entropy_with_integer_labels(logits, tokens[:, first + 1 :])
        weight = jnp.broadcast_to(batch["weight"][:, None], error.shape)
        return {"token": (jnp.sum(error * weight), jnp.sum(weight))}

    def prepare(self, clips: Store, assets: Assets, folder: Path, max_damaged: float) -> Store:
        """Encodes every clip; stores the tokens beside the clips for all runs with this tokenizer."""
        codec = self._codec(assets)

        def encode(clip: Record) -> Record:
            return {name: x[0] for name, x in codec.encode(Video(clip["rgb"][None])).items()} | described(clip)

        size = self.clips.image_size
        return prepare_store(clips, self.config.autoencoder, codec.params, encode, size, folder, max_damaged)

    def transform(self, normalization: Normalization) -> Transform:
        return partial(_arrays, self.architecture.layout, normalization, self.config.integrate_actions)

    def example(self, rng: np.random.Generator) -> Record:
        layout = self.architecture.layout
        clips = self.clips
        later = clips.frames - layout.context
        return {
            "context": rng.integers(0, layout.codes, (layout.context, layout.cells), np.int32),
            "future": rng.integers(0, layout.codes, (later, layout.tokens), np.int32),
            "actions": rng.normal(size=(clips.frames, clips.action_dim)).astype(np.float32),
        }

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
        inputs = assets.normalization.action_inputs(actions, self.config.integrate_actions)
        numbers = np.arange(len(prompt)) if index is None else np.asarray(index)
        return Video(generate(self.architecture, self._codec(assets), params, prompt.rgb, inputs, numbers))

    def reconstruct(self, assets: Assets, video: Video) -> Video:
        codec = self._codec(assets)
        return codec.decode(codec.encode(video))

    def pretrained_shapes(self, directory: Path) -> Params:
        """Returns the shapes of a saved LLaMA, with or without actions; a model without actions may start from either.

        Raises:
            UserError: the weights are missing or of another network; the message names the differing fields.
        """
        saved = read_model(directory, IVideoGPTConfig, "world_model")
        check_alike(directory, saved, self.config, FREE, "model")
        codes = saved.autoencoder.codes
        own = self.config.autoencoder.codes
        if codes != own:
            raise UserError(f"{directory}: knows {codes} codes, this tokenizer has {own}; set model.autoencoder.codes")
        arch = self.architecture
        actions = saved_inputs(directory).action_dim * (1 + saved.integrate_actions)
        if saved.use_actions and arch.action_inputs and actions != arch.action_inputs:
            raise UserError(
                f"{directory}: its model reads actions of {actions} numbers, this one of {arch.action_inputs}; only a "
                f"model without actions fits any"
            )
        like = Architecture(self.config, arch.layout, actions * saved.use_actions)
        return jax.eval_shape(LLaMA(like).init_params, jax.random.key(0))

    def start(self, fresh: Params, saved: Params, directory: Path) -> Params:
        """Returns the saved parameters without a layer of actions that this model lacks.

        If they lack that layer, the fresh one, which is zero, is added.
        """
        return {name: saved.get(name, x) for name, x in fresh.items()}

    def cache_shapes(self, frames: int) -> Any:
        arch = self.architecture
        return jax.eval_shape(lambda: empty_cache(arch, 1, arch.layout.length(frames) + 1))

    def flops(self, frames: int) -> dict[str, int]:
        """Counts matrix products, 2 per multiply-add; attention in full, because masked products are computed too."""
        cfg = self.config
        layout = self.architecture.layout
        length = layout.length(frames) - 1
        block = 2 * length * cfg.width * (4 * cfg.width + 3 * cfg.mlp_width) + 4 * length**2 * cfg.width
        head = 2 * (length - layout.first_slot) * cfg.width * layout.vocabulary
        forward = cfg.blocks * block + head
        return {"forward": forward, "train": 3 * forward}

    def _codec(self, assets: Assets) -> ConditionalCodec:
        assert assets.tokenizer is not None
        return ConditionalCodec(self.config.autoencoder, assets.tokenizer)


def _arrays(
    layout: Layout, normalization: Normalization, integrate: bool, record: Record, rng: np.random.Generator
) -> Arrays:
    """Returns ``tokens`` (L,), a clip's sequence, and ``actions`` (F, A), which led to its later frames."""
    tokens = layout.join(record["context"][None], record["future"][None])[0]
    return {"tokens": tokens, "actions": normalization.action_inputs(record["actions"], integrate)[layout.context :]}
