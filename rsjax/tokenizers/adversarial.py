"""The adversarial terms of the tokenizer's training (reference: Open-MAGVIT2). Each returns (weighted sum, weight).

The generator's term has gradients only for the tokenizer, the discriminator's terms only for the discriminator, so one
gradient of their sum equals the reference's two. As there, both use the parameters from before the step.

Axes: B images, H×W pixels.
"""

from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax.config import TokenizerTrainConfig
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
    train: TokenizerTrainConfig,
    params: Params,
    target: Float[Array, "B H W 3"],
    output: Float[Array, "B H W 3"],
    active: Scalar,
    averages: Averages,
    axis_name: str | None,
) -> dict[str, Term]:
    """Returns the terms of one batch, named as their weights in :class:`TokenizerTrainConfig`.

    Args:
        params: the discriminator's.
        target: real images in [-1, 1].
        output: their reconstructions.
        active: 1, or 0 before ``disc_start``.
        averages: LeCAM's, from the previous step.
        axis_name: pmap's axis; None if XLA sees the whole batch.

    Returns:
        "adversarial", the non-saturating loss of each image's mean logit; "hinge"; "lecam"; and "real_logit" and
        "fake_logit", which carry no gradient.
    """
    # Batch norm must not mix real and fake images, hence three passes (XLA merges the two on fakes).
    judge = cast(Callable[[Any, Array], Array], lambda p, images: Discriminator(axis_name).apply({"params": p}, images))
    fooled = judge(jax.lax.stop_gradient(params), output)
    real, fake = judge(params, target), judge(params, jax.lax.stop_gradient(output))

    count = jnp.float32(len(target))
    logits = {name: (jax.lax.stop_gradient(jnp.mean(x)) * count, count) for name, x in (("real", real), ("fake", fake))}
    global_means = {
        name: _total(value, axis_name) / _total(weight, axis_name) for name, (value, weight) in logits.items()
    }
    anchors = updated_averages(averages, **global_means, decay=train.lecam_decay)
    means = {
        "adversarial": jnp.mean(jax.nn.softplus(-jnp.mean(fooled, axis=(1, 2)))),
        "hinge": jnp.mean(jax.nn.relu(1 - real)) + jnp.mean(jax.nn.relu(1 + fake)),
        "lecam": _mean_square_excess(real - anchors["fake"]) + _mean_square_excess(anchors["real"] - fake),
    }
    terms = {name: (active * mean * count, count) for name, mean in means.items()}
    return terms | {"real_logit": logits["real"], "fake_logit": logits["fake"]}


def _total(x: Scalar, axis_name: str | None) -> Scalar:
    return jax.lax.psum(x, axis_name) if axis_name else x


def _mean_square_excess(x: Array) -> Scalar:
    return jnp.mean(jnp.square(jax.nn.relu(x)))
