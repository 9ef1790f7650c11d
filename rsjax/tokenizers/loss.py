"""The tokenizer's training terms (reference: Open-MAGVIT2). Each returns (weighted sum, weight)."""

from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rsjax.config import TokenizerConfig, TokenizerTrainConfig
from rsjax.tokenizers import lfq
from rsjax.tokenizers.adversarial import Term, adversarial_terms
from rsjax.tokenizers.lpips import lpips
from rsjax.tokenizers.magvit2 import Tokenizer, to_unit

Images = Float[Array, "B H W 3"]
Latents = Float[Array, "B h w D"]


def tokenizer_terms(
    config: TokenizerConfig,
    train: TokenizerTrainConfig,
    params: Any,
    images: Float[Array, "B H W 3"],
    step: Int[Array, ""],
    extra: Any = None,
    axis_name: str | None = None,
) -> dict[str, Term]:
    """All terms of one batch of images (0–255) that are on, named as their weights in :class:`TokenizerTrainConfig`.

    Args:
        params: the tokenizer's; with an adversarial term {"generator": the tokenizer's, "discriminator": …}.
        step: steps done before this one.
        extra: "lpips", the metric's weights, and "lecam", the logits' averages, each where its term is on.
        axis_name: of pmap, over which the batch is cut; None where XLA sees the whole batch.
    """
    weights = train.weights
    generator = params["generator"] if "adversarial" in weights else params
    target = to_unit(images)
    output, latents = cast(tuple[Images, Latents], Tokenizer(config).apply({"params": generator}, target))
    count = jnp.float32(images.shape[0])
    error = (target - output).astype(jnp.float32)
    total = (lambda x: jax.lax.psum(x, axis_name)) if axis_name else (lambda x: x)
    means = {
        "l1": jnp.mean(jnp.abs(error)),
        "l2": jnp.mean(jnp.square(error)),
        "entropy": lfq.entropy_loss(latents, train.entropy_temperature, total),
        "commitment": lfq.commitment_loss(latents),
    }
    if "perceptual" in weights:
        means["perceptual"] = jnp.mean(lpips(extra["lpips"], target, output))
    terms = {name: (mean * count, count) for name, mean in means.items()}
    if "adversarial" in weights:
        active = (step >= train.disc_start).astype(jnp.float32)
        terms |= adversarial_terms(train, params["discriminator"], target, output, active, extra["lecam"], axis_name)
    return terms
