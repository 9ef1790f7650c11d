"""The tokenizer's training terms (reference: Open-MAGVIT2). Each returns (weighted sum, weight)."""

from typing import cast

import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax.config import TokenizerConfig, TokenizerTrainConfig
from rsjax.tokenizer import lfq
from rsjax.tokenizer.magvit2 import Tokenizer, to_unit

Images = Float[Array, "B H W 3"]
Latents = Float[Array, "B h w D"]
Term = tuple[Float[Array, ""], Float[Array, ""]]


def tokenizer_terms(
    config: TokenizerConfig, train: TokenizerTrainConfig, params: dict, images: Float[Array, "B H W 3"]
) -> dict[str, Term]:
    """All terms of one batch of images (0–255), named as their weights in :class:`TokenizerTrainConfig`.

    The batch average inside the entropy term is that of this device's images.
    """
    target = to_unit(images)
    output, latents = cast(tuple[Images, Latents], Tokenizer(config).apply({"params": params}, target))
    count = jnp.float32(images.shape[0])
    error = (target - output).astype(jnp.float32)
    means = {
        "l1": jnp.mean(jnp.abs(error)),
        "l2": jnp.mean(jnp.square(error)),
        "entropy": lfq.entropy_loss(latents, train.entropy_temperature),
        "commitment": lfq.commitment_loss(latents),
    }
    return {name: (mean * count, count) for name, mean in means.items()}
