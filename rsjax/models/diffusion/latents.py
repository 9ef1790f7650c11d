"""Training of autoencoders with a Gaussian posterior, whose latents are standardised channel by channel.

Axes: B rows of a batch, z latent channels.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from rsjax.trainable import Params, Scalar

LOG_VARIANCE = (-30.0, 20.0)  # limits of the posterior's, as in the public code
Pixels = Float[Array, "*N 3"]
Latents = Float[Array, "*M z"]


def posterior(made: Float[Array, "*M z2"]) -> tuple[Latents, Latents]:
    """Returns the mean and the log-variance that an encoder made."""
    mean, log_variance = jnp.split(made, 2, axis=-1)
    return mean, jnp.clip(log_variance, *LOG_VARIANCE)


def draw(mean: Latents, log_variance: Latents, key: Key[Array, ""], index: Int[Array, " B"]) -> Latents:
    """Returns a sample of the posterior, whose noise each row's number decides."""
    noise = jax.vmap(lambda number: jax.random.normal(jax.random.fold_in(key, number), mean.shape[1:]))
    return mean + jnp.exp(log_variance / 2) * noise(index)


def means_of_terms(
    images: Pixels, output: Pixels, mean: Latents, log_variance: Latents, latents: Latents, fitted: Params
) -> dict[str, Scalar]:
    """Returns the terms "l1" and "l2" of the reconstruction, and

    - "kl": the divergence of the posterior from the normal distribution, per number;
    - "standard": -log p of the latents under ``fitted``, which so become their mean and deviation.

    Args:
        fitted: the channels' "mean" and "log_deviation" among the parameters.
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
    """Returns latents as the decoder takes them: the inverse of :func:`standardised`."""
    return latents * jnp.exp(fitted["log_deviation"]) + fitted["mean"]
