"""Loss terms and standardised latents of autoencoders with a Gaussian posterior.

Axes: B rows of a batch, z latent channels.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from rsjax.trainable import Params, Scalar

LOG_VARIANCE = (-30.0, 20.0)  # limits of the posterior's log-variance, as in the public code
Pixels = Float[Array, "*N 3"]
Latents = Float[Array, "*M z"]


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
