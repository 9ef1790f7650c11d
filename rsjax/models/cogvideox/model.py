"""The CogVideoX family: makes the clips' latents, computes the velocity's error, and generates videos.

Axes: B clips, T frames, F latent frames of h×w cells with C channels, D noisy encodings of an image.
"""

import zlib
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
from rsjax.config.config_fields import with_values
from rsjax.data.codec import Record
from rsjax.data.loader import Arrays, Transform
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store
from rsjax.models.base import Assets, WorldModel, implements
from rsjax.models.cogvideox import pretrained
from rsjax.models.cogvideox.autoencoder import CausalCodec, CausalVAETraining, notes_on_filling
from rsjax.models.cogvideox.config import CogVideoXConfig, TextConfig
from rsjax.models.cogvideox.rollout import rollout
from rsjax.models.cogvideox.text import EMPTY, check_store, check_tasks, empty_texts, texts_of, write_texts
from rsjax.models.cogvideox.transformer import Architecture, Transformer, forward_flops
from rsjax.models.diffusion.schedule import add_noise, target
from rsjax.progress import note
from rsjax.tokenizers.autoencoder import Autoencoder
from rsjax.tokenizers.tokenize import described, prepare_store
from rsjax.trainable import Params, StepContext, Term

Batch = dict[str, Any]  # latents (B, F, h, w, C), image (B, h, w, C), text (B, …), weight and index (B,)


@implements(CogVideoXConfig)
@dataclass(frozen=True)
class CogVideoX(WorldModel[Batch]):
    """The diffusion transformer on the latents of the causal autoencoder.

    Attributes:
        config: the family's settings.
        clips: the shape of the training clips.
    """

    config: CogVideoXConfig
    clips: ClipShape

    @classmethod
    def create(cls, config: Config) -> "CogVideoX":
        assert isinstance(config.model, CogVideoXConfig)
        return cls(config.model, config.clips)

    @classmethod
    def autoencoder(cls, config: Config) -> Autoencoder[Any]:
        return CausalVAETraining.create(config)

    @classmethod
    def with_random_files(cls, config: Config, folder: Path) -> Config:
        assert isinstance(config.model, CogVideoXConfig)
        text = config.model.text
        path = folder / "text.safetensors"
        if not text.file:
            return config
        embeddings = np.random.default_rng(0).normal(size=(1, text.tokens, text.width)).astype(np.float32)
        path.write_bytes(write_texts([EMPTY], embeddings))
        return with_values(config, {"model.text.file": str(path)})

    @property
    def loss_weights(self) -> dict[str, float]:
        return self.config.loss_weights

    @property
    def architecture(self) -> Architecture:
        """The network's settings."""
        return Architecture.create(self.config, self.clips)

    def init(self, key: Key[Array, ""]) -> Params:
        return Transformer(self.architecture).init_params(key)

    def loss_terms(self, params: Params, batch: Batch, key: Key[Array, ""], context: StepContext) -> dict[str, Term]:
        """Returns "error": the mean squared error of the velocity over all noisy latent frames."""
        noise = self.config.noise
        latents = batch["latents"]

        def draw(index: Int[Array, ""]) -> tuple[Array, Array]:
            t_key, noise_key = jax.random.split(jax.random.fold_in(key, index))
            return jax.random.randint(t_key, (), 0, noise.steps), jax.random.normal(noise_key, latents.shape[1:])

        t, drawn = jax.vmap(draw)(batch["index"])
        noisy = add_noise(noise, latents, drawn, t)
        image = batch["image"]
        past = 0  # latent frames that are known
        if self.config.image != "channels":
            noisy = noisy.at[:, 0].set(image)
            image = None
            past = 1
        predicted: Any = Transformer(self.architecture).apply({"params": params}, noisy, t, batch["text"], image)
        error = jnp.square(predicted - target(noise, latents, drawn, t))[:, past:]
        weight = batch["weight"].astype(jnp.float32)
        return {"error": (jnp.sum(weight * jnp.mean(error, axis=(1, 2, 3, 4))), jnp.sum(weight))}

    def check_files(self) -> None:
        """Checks the file of texts, if there is one."""
        check_tasks(self.config.text, ())

    def check_clips(self, clips: Store) -> None:
        """Checks that every task has a text."""
        check_store(self.config.text, clips)

    def prepare(self, clips: Store, assets: Assets, folder: Path, max_damaged: float) -> Store:
        """Encodes every clip and its image; stores the latents beside the clips for all runs with this autoencoder.

        Raises:
            UserError: a task of the clips has no text.
        """
        codec = self._codec(assets)
        for line in notes_on_filling("clips", self.clips.frames):
            note(line)

        def encode(clip: Record) -> Record:
            rng = np.random.default_rng(zlib.crc32(clip["rgb"][0].tobytes()))
            video = codec.encode(Video(clip["rgb"][None]))
            image = codec.images(clip["rgb"][:1], rng)
            latents = {name: video[name] for name in ("mean", "deviation")}
            latents |= {f"image_{name}": x for name, x in image.items()}
            return {name: x[0].astype(np.float16) for name, x in latents.items()} | described(clip)

        size = self.clips.image_size
        store = prepare_store(clips, codec.config, codec.params, encode, size, folder, max_damaged)
        self.check_clips(store)
        return store

    def transform(self, normalization: Normalization) -> Transform:
        return partial(latent_arrays, self.config.text, self.config.image_dropout)

    def example(self, rng: np.random.Generator) -> Record:
        arch = self.architecture
        text = self.config.text
        draws = max(1, self.config.autoencoder.image_draws)
        cells = (arch.rows, arch.columns, arch.channels)
        shapes = {"": (arch.frames, *cells), "image_": (draws, *cells)}
        means = {f"{name}mean": rng.normal(size=shape).astype(np.float16) for name, shape in shapes.items()}
        record = means | {f"{name}deviation": np.full(shape, 0.1, np.float16) for name, shape in shapes.items()}
        if text.file:
            return record | {"text": rng.normal(size=(text.tokens, text.width)).astype(np.float32)}
        return record | {"text": np.int32(1)}

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
        """Generates videos from the prompts' last frames and tasks; reads only the length T of the actions."""
        numbers = np.arange(len(prompt)) if index is None else np.asarray(index)
        frames = actions.shape[1]
        codec = self._codec(assets)
        return Video(rollout(self.architecture, codec, self.clips.frames, params, prompt, frames, numbers))

    def reconstruct(self, assets: Assets, video: Video) -> Video:
        codec = self._codec(assets)
        return codec.decode(codec.encode(video))

    def pretrained_shapes(self, directory: Path) -> Params:
        return pretrained.shapes_of(directory, self.config)

    def start(self, fresh: Params, saved: Params, directory: Path) -> Params:
        return pretrained.completed(fresh, saved)

    def flops(self, frames: int) -> dict[str, int]:
        forward = forward_flops(self.architecture)
        return {"forward": forward, "train": 3 * forward}

    def _codec(self, assets: Assets) -> CausalCodec:
        assert assets.tokenizer is not None
        return CausalCodec(self.config.autoencoder, assets.tokenizer)


def latent_arrays(text: TextConfig, image_dropout: float, record: Record, rng: np.random.Generator) -> Arrays:
    """Samples the latents of a record and of one of its noisy images (or zeros); adds its text or the empty text."""
    latents, images = (
        record[f"{name}mean"].astype(np.float32)
        + record[f"{name}deviation"] * rng.standard_normal(record[f"{name}mean"].shape, np.float32)
        for name in ("", "image_")
    )
    image = images[rng.integers(len(images))] * np.float32(rng.random() >= image_dropout)
    if rng.random() < text.dropout:
        shown = empty_texts(text, 1)[0]
    else:  # the random records of benchmarks contain their text
        shown = record["text"] if "text" in record else texts_of(text, [record["task"]], 1)[0]
    return {"latents": latents, "image": image, "text": shown}
