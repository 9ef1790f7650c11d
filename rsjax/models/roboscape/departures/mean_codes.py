"""Frames are decoded from each cell's mean code under the model's probabilities, not from its most probable token.

They are blurred where the model is unsure, and closer to the truth on average. With ``sample.read_means`` later frames
read the mean codes too, and so know where the model was unsure (notebooks/miniature.md).

Axes: B clips, T frames, S cells, D code bits.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rsjax.config import SampleConfig
from rsjax.tokenizers import lfq

Means = dict[str, Float[Array, "*B S D"]]


def codes_of(sample: SampleConfig, tokens: dict[str, Int[Array, "*B S"]], code_bits: int) -> Means:
    """Returns the codes of these tokens by branch; empty if frames are decoded from tokens."""
    if not sample.shows_means:
        return {}
    return {branch: lfq.tokens_to_codes(cells, code_bits) for branch, cells in tokens.items()}


def read(
    sample: SampleConfig, tokens: dict[str, Int[Array, "*B S"]], means: Means
) -> dict[str, Int[Array, "*B S"]] | Means:
    """Returns what later passes read of these frames: their tokens, or their mean codes with ``read_means``."""
    if sample.reads_means:
        return means
    return tokens


def decided(mask: Bool[Array, " S"], logits: dict[str, Float[Array, "S n V"]], means: Means, code_bits: int) -> Means:
    """Returns one frame's mean codes after a decoding step: new ones where ``mask``; empty if ``means`` is."""
    out = {}
    for branch, old in means.items():
        out[branch] = jnp.where(mask[:, None], lfq.mean_codes(logits[branch], code_bits), old)
    return out
