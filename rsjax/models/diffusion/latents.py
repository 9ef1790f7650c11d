"""Autoencoders with a Gaussian posterior: their training and their standardised latents.

Axes: B rows of a batch, z latent channels.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, UInt8

from rsjax.config import TokenizerTrainConfig
from rsjax.tokenizers.autoencoder import Autoencoder
from rsjax.tokenizers.lpips import lpips
from rsjax.tokenizers.magvit2 import to_frames, to_unit
from rsjax.tokenizers.training import lpips_weights
from rsjax.trainable import Extra, Params, Scalar, StepContext, Term

LOG_VARIANCE = (-30.0, 20.0)  # limits of the posterior's log-variance, as in the public code
Pixels = Float[Array, "*N 3"]
Latents = Float[Array, "*M z"]
Network = Callable[[Any, Params, Any], Array]  # an encoder or a decoder, of its settings, parameters and input
Batch = dict[
    str, Any
]  # "frames", images or videos of 0–255 (B, …, H, W, 3), and "index" (B,), which determines the noise


@dataclass(frozen=True)
class PosteriorTraining(Autoencoder[Batch]):
    """Trains an autoencoder to reconstruct RGB frames from a sample of their posterior.

    A family adds the network: :meth:`posterior`, :meth:`decode`, ``init`` and the other methods of an autoencoder. The
    parameters contain "latents", the "mean" and "log_deviation" of each channel.

    Attributes:
        config: settings of the network, with ``kl_weight``.
        train: settings of the training.
        image_size: pixels per side of an image.
    """

    config: Any
    train: TokenizerTrainConfig
    image_size: int

    def posterior(self, params: Params, frames: Pixels) -> tuple[Latents, Latents]:
        """Returns the mean and the log-variance of the latents of frames in [-1, 1]; they are not standardised."""
        raise NotImplementedError

    def decode(self, params: Params, latents: Latents) -> Pixels:
        """Decodes latents that are not standardised."""
        raise NotImplementedError

    @property
    def loss_weights(self) -> dict[str, float]:
        weights = {name: w for name, w in self.train.loss_weights.items() if name in ("l1", "l2", "perceptual")}
        return weights | {"kl": self.config.kl_weight, "standard": 1.0}

    def init_extra(self) -> Extra:
        if "perceptual" not in self.loss_weights:
            return None
        return {"lpips": lpips_weights(self.train, self.image_size)}

    def loss_terms(self, params: Params, batch: Batch, key: Key[Array, ""], context: StepContext) -> dict[str, Term]:
        """Returns the terms of :func:`means_of_terms`, and "perceptual" if it is on."""
        frames = to_unit(batch["frames"])
        mean, log_variance = self.posterior(params, frames)
        latents = draw(mean, log_variance, key, batch["index"])
        output = self.decode(params, latents)
        means = means_of_terms(frames, output, mean, log_variance, latents, params["latents"])
        if "perceptual" in self.loss_weights:
            assert context.extra is not None
            images = (x.reshape(-1, *x.shape[-3:]) for x in (frames, output))
            means["perceptual"] = jnp.mean(lpips(context.extra["lpips"], *images))
        count = jnp.float32(len(frames))
        return {name: (means[name] * count, count) for name in self.loss_weights}


def posterior(made: Float[Array, "*M z2"]) -> tuple[Latents, Latents]:
    """Splits an encoder's output into the mean and the log-variance, which is clipped to ``LOG_VARIANCE``."""
    mean, log_variance = jnp.split(made, 2, axis=-1)
    return mean, jnp.clip(log_variance, *LOG_VARIANCE)


def draw(mean: Latents, log_variance: Latents, key: Key[Array, ""], index: Int[Array, " B"]) -> Latents:
    """Returns a sample of the posterior; each row's number determines its noise."""
    noise = jax.vmap(lambda number: jax.random.normal(jax.random.fold_in(key, number), mean.shape[1:]))
    return mean + jnp.exp(log_variance / 2) * noise(index)


def means_of_terms(
    images: Pixels, output: Pixels, mean: Latents, log_variance: Latents, latents: Latents, fitted: Params
) -> dict[str, Scalar]:
    """Returns the terms "l1" and "l2" of the reconstruction, and two of the latents.

    - "kl": the divergence of the posterior from the normal distribution, per number;
    - "standard": -log p of the latents under ``fitted``, which therefore learns their mean and deviation.

    Args:
        fitted: the parameters "mean" and "log_deviation" of each channel.
    """
    own = (jax.lax.stop_gradient(latents) - fitted["mean"]) * jnp.exp(-fitted["log_deviation"])
    return {
        "l1": jnp.mean(jnp.abs(images - output)),
        "l2": jnp.mean(jnp.square(images - output)),
        "kl": jnp.mean(jnp.square(mean) + jnp.exp(log_variance) - 1 - log_variance) / 2,
        "standard": jnp.mean(fitted["log_deviation"]) + jnp.mean(jnp.square(own)) / 2,
    }


def standardised(made: Float[Array, "*M z2"], fitted: Params) -> Float[Array, "*M z2"]:
    """Returns the standardised mean and deviation of an encoder's posterior."""
    mean, log_variance = posterior(made)
    scale = jnp.exp(-fitted["log_deviation"])
    return jnp.concatenate([(mean - fitted["mean"]) * scale, jnp.exp(log_variance / 2) * scale], axis=-1)


def original(latents: Any, fitted: Params) -> Latents:
    """Returns latents in the decoder's scale: the inverse of :func:`standardised`."""
    return latents * jnp.exp(fitted["log_deviation"]) + fitted["mean"]


@partial(jax.jit, static_argnums=(0, 1))
def encode_pixels(encode: Network, config: Any, params: Params, pixels: Any) -> Float[Array, "*M z2"]:
    """Returns the standardised mean and deviation of the posterior of frames of 0–255."""
    return standardised(encode(config, params, to_unit(pixels)), params["latents"])


@partial(jax.jit, static_argnums=(0, 1))
def decode_pixels(decode: Network, config: Any, params: Params, latents: Any) -> UInt8[Array, "*N 3"]:
    """Decodes standardised latents to frames."""
    return to_frames(decode(config, params, original(latents, params["latents"])))
