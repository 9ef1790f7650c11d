"""The adversarial terms of the tokenizer's training (reference: Open-MAGVIT2). Each returns (weighted sum, weight).

The generator's term has gradients only for the tokenizer, the discriminator's terms only for the discriminator, so one
gradient of their sum equals the reference's two. As there, both use the parameters from before the step.

Axes: B images, H×W pixels.
"""

from typing import cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax.config import AdversarialConfig
from rsjax.tokenizers.discriminator import Discriminator
from rsjax.trainable import Params, Scalar, Term

Averages = dict[str, Scalar]  # of the logits of "real" and of "fake" images


def initial_averages() -> Averages:
    """Returns LeCAM's averages before the first step."""
    return {"real": jnp.zeros(()), "fake": jnp.zeros(())}


def updated_averages(averages: Averages, real: Scalar, fake: Scalar, decay: float) -> Averages:
    """Returns LeCAM's averages after a step whose mean logits over all devices were ``real`` and ``fake``."""
    new = {"real": real, "fake": fake}
    return {name: decay * averages[name] + (1 - decay) * new[name] for name in averages}


def adversarial_terms(
    config: AdversarialConfig,
    params: Params,
    target: Float[Array, "B H W 3"],
    output: Float[Array, "B H W 3"],
    active: Scalar,
    averages: Averages,
    axis_name: str | None,
) -> dict[str, Term]:
    """Returns the terms of one batch, named as their weights in :class:`rsjax.config.TokenizerTrainConfig`.

    Args:
        params: the discriminator's.
        target: real images in [-1, 1].
        output: their reconstructions.
        active: 1, or 0 before ``config.start``.
        averages: LeCAM's, from the previous step.
        axis_name: pmap's axis; None if XLA sees the whole batch.

    Returns:
        "adversarial", the non-saturating loss of each image's mean logit; "hinge"; "lecam"; and "real_logit" and
        "fake_logit", which carry no gradient.
    """

    def logits(params: Params, images: Float[Array, "B H W 3"]) -> Float[Array, "B h w"]:
        return cast(Array, Discriminator(axis_name).apply({"params": params}, images))

    # Batch norm must not mix real and fake images, hence three passes (XLA merges the two on fakes).
    fooled = logits(jax.lax.stop_gradient(params), output)
    real = logits(params, target)
    fake = logits(params, jax.lax.stop_gradient(output))

    count = jnp.float32(len(target))
    real_sum = jax.lax.stop_gradient(jnp.mean(real)) * count
    fake_sum = jax.lax.stop_gradient(jnp.mean(fake)) * count
    real_mean = _total(real_sum, axis_name) / _total(count, axis_name)
    fake_mean = _total(fake_sum, axis_name) / _total(count, axis_name)
    anchors = updated_averages(averages, real_mean, fake_mean, config.lecam_decay)
    means = {
        "adversarial": jnp.mean(jax.nn.softplus(-jnp.mean(fooled, axis=(1, 2)))),
        "hinge": jnp.mean(jax.nn.relu(1 - real)) + jnp.mean(jax.nn.relu(1 + fake)),
        "lecam": _mean_square_excess(real - anchors["fake"]) + _mean_square_excess(anchors["real"] - fake),
    }
    terms = {name: (active * mean * count, count) for name, mean in means.items()}
    return terms | {"real_logit": (real_sum, count), "fake_logit": (fake_sum, count)}


def _total(x: Scalar, axis_name: str | None) -> Scalar:
    if axis_name is None:
        return x
    return jax.lax.psum(x, axis_name)


def _mean_square_excess(x: Array) -> Scalar:
    return jnp.mean(jnp.square(jax.nn.relu(x)))
