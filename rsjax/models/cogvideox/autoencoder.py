"""Trains CogVideoX's autoencoder on the frames of clips, and encodes and decodes videos with the trained one.

Videos are padded to 8k + 1 frames by repeating the last frame, as in the public fine-tuner: the public code loses
frames of videos of other lengths. Latents are standardised channel by channel, with numbers in the parameters
("latents"): for public weights the public factor, and for a trained autoencoder numbers that its training fits.

Axes: B videos, T frames, H×W pixels, t latent frames of h×w cells, z latent channels, D draws.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Key, UInt8

from rsjax.clip import Video
from rsjax.config import Config, require
from rsjax.data.codec import Record
from rsjax.data.loader import Arrays, Transform
from rsjax.data.normalization import Normalization
from rsjax.devices import divide
from rsjax.models.cogvideox import causal_vae as vae
from rsjax.models.cogvideox.config import COMPRESSION, CausalVAEConfig, CogVideoXConfig, padded_frames
from rsjax.models.diffusion import latents as distributions
from rsjax.models.network_settings import check_alike, read_model
from rsjax.tokenizers.codec import images_per_pass, in_chunks
from rsjax.tokenizers.flops import traced_flops
from rsjax.tokenizers.training import require_no_adversarial
from rsjax.trainable import Params

FREE = {"kl_weight", "image_draws", "image_noise", "compute_dtype"}


def init(config: CausalVAEConfig, key: Key[Array, ""]) -> Params:
    """Returns initial parameters of "encoder", "decoder" and "latents"."""
    z = config.latent_channels
    size = 2 * config.downsampling
    return {
        "encoder": vae.CausalEncoder(config).init(key, jnp.zeros((1, 1, size, size, 3)))["params"],
        "decoder": vae.CausalDecoder(config).init(jax.random.fold_in(key, 1), jnp.zeros((1, 1, 2, 2, z)))["params"],
        "latents": {"mean": jnp.zeros(z), "log_deviation": jnp.zeros(z)},
    }


@dataclass(frozen=True)
class CausalVAETraining(distributions.PosteriorTraining):
    """Trains the autoencoder to reconstruct consecutive frames from a sample of their posterior."""

    config: CausalVAEConfig

    def __post_init__(self) -> None:
        require_no_adversarial(self.train, "CogVideoX's autoencoder")
        require(
            self.train.steps > 0 or bool(self.train.start_from),
            "tokenizer_train.steps is 0, so the autoencoder stays as it is saved, but tokenizer_train.start_from is "
            "empty; name the directory that rsjax convert cogvideox made",
        )

    @classmethod
    def create(cls, config: Config) -> "CausalVAETraining":
        """Returns the training of the autoencoder of a configuration whose model is CogVideoX."""
        assert isinstance(config.model, CogVideoXConfig)
        return cls(config.model.autoencoder, config.tokenizer_train, config.clips.image_size)

    def init(self, key: Key[Array, ""]) -> Params:
        return init(self.config, key)

    def posterior(self, params: Params, frames: Any) -> tuple[Array, Array]:
        return distributions.posterior(vae.encode(self.config, params, frames))

    def decode(self, params: Params, latents: Any) -> Array:
        return vae.decode(self.config, params, latents)

    def transform(self) -> Transform:
        return partial(_window, self.train.frames_per_clip, self.train.flip)

    def batch(self, arrays: Arrays) -> distributions.Batch:
        return {name: arrays[name] for name in ("frames", "index")}

    def codec(self, params: Params, normalization: Normalization) -> "CausalCodec":
        return CausalCodec(self.config, params)

    def notes(self) -> list[str]:
        if self.train.steps == 0:
            return []
        return notes_on_filling("windows", self.train.frames_per_clip)

    def flops(self) -> dict[str, int]:
        count = self.train.frames_per_clip
        frames = (1, padded_frames(count), self.image_size, self.image_size, 3)
        config = replace(self.config, compute_dtype="float32")  # products of bf16 operands multiply padding too

        def encode(params: Params, frames: Any) -> Array:
            return distributions.posterior(vae.encode(config, params, frames))[0]

        whole = traced_flops(self.shapes(), frames, encode, partial(vae.decode, config))
        return {half: number // count for half, number in whole.items()}

    def pretrained_shapes(self, directory: Path) -> Params:
        """Returns the shapes of saved weights.

        Raises:
            UserError: the weights are missing or of another network; the message names the differing fields.
        """
        saved = read_model(directory, CogVideoXConfig, "tokenizer").autoencoder
        check_alike(directory, saved, self.config, FREE, "model.autoencoder")
        return jax.eval_shape(partial(init, saved), jax.random.key(0))


def notes_on_filling(what: str, frames: int) -> list[str]:
    """Returns a line that says to how many frames videos are padded; none if they need no padding."""
    whole = padded_frames(frames)
    if whole == frames:
        return []
    return [f"{what} of {frames} frames are encoded as {whole}, 8k + 1, by repeating the last"]


def filled(frames: np.ndarray, axis: int) -> np.ndarray:
    """Repeats the last frame until there are 8k + 1 frames."""
    count = frames.shape[axis]
    return frames.take(np.minimum(np.arange(padded_frames(count)), count - 1), axis)


def _window(count: int, flip: bool, record: Record, rng: np.random.Generator) -> Arrays:
    """Returns ``frames``: at most ``count`` consecutive frames of a clip, padded to 8k + 1."""
    rgb = record["rgb"]
    first = rng.integers(0, max(0, len(rgb) - count) + 1)
    frames = filled(rgb[first : first + count], 0)
    if flip and rng.random() < 0.5:
        frames = np.ascontiguousarray(frames[:, :, ::-1])
    return {"frames": frames}


@dataclass(frozen=True)
class CausalCodec:
    """A trained autoencoder that takes and returns numpy arrays. The latents are standardised."""

    config: CausalVAEConfig
    params: Params

    def encode(self, video: Video) -> dict[str, np.ndarray]:
        """Returns the posterior's "mean" and "deviation", (B, t, h, w, z), and the number of "frames", (B,)."""
        count = np.full(len(video), video.rgb.shape[1], np.int32)
        return self._encode(filled(video.rgb, 1)) | {"frames": count}

    def decode(self, tokens: dict[str, Any], has_depth: Bool[np.ndarray, " B"] | None = None) -> Video:
        """Decodes "mean", the latents of an odd number of latent frames, and keeps "frames" frames if that is given."""
        latents = np.asarray(tokens["mean"])
        most = images_per_pass(latents.shape[-2] * self.config.downsampling) // (COMPRESSION * latents.shape[1])
        frames = in_chunks(partial(self._run, distributions.decode_pixels, vae.decode), latents, 4, max(1, most))
        if "frames" in tokens:
            frames = frames[:, : tokens["frames"][0]]
        return Video(frames)

    def images(
        self, rgb: UInt8[np.ndarray, "B H W 3"], rng: np.random.Generator | None = None
    ) -> dict[str, np.ndarray]:
        """Returns the latents of the images that videos begin with, "mean" and "deviation", (B, D, h, w, z).

        Args:
            rng: draws the noise of ``config.image_draws`` noisy copies; None: the images get no noise and D is 1.
        """
        copies = 1
        if rng is not None:
            copies = max(1, self.config.image_draws)
        pixels = np.repeat(rgb[:, None], copies, axis=1).astype(np.float32)
        if rng is not None and self.config.image_draws:
            spread = np.exp(rng.normal(*self.config.image_noise, pixels.shape[:2]))[..., None, None, None]
            pixels += 127.5 * spread * rng.standard_normal(pixels.shape, np.float32)
        made = self._encode(pixels.astype(np.float32).reshape(-1, 1, *rgb.shape[1:]))
        return {name: x.reshape(*pixels.shape[:2], *x.shape[2:]) for name, x in made.items()}

    def _encode(self, frames: np.ndarray) -> dict[str, np.ndarray]:
        most = images_per_pass(frames.shape[2]) // frames.shape[1]
        made = in_chunks(partial(self._run, distributions.encode_pixels, vae.encode), frames, 4, max(1, most))
        return dict(zip(("mean", "deviation"), np.split(made, 2, axis=-1), strict=True))

    def _run(self, function: Any, network: distributions.Network, chunk: np.ndarray) -> Any:
        return function(network, self.config, self.params, divide(chunk, self.params))
