"""Sampling amplifies what actions change: logits are without + g·(with - without the actions), g = ``sample.guidance``.

This is classifier-free guidance (arXiv 2207.12598); ``action_dropout`` trains a model for it. Every pass and the cache
cover all clips twice: first with their actions, then without.

Axes: B clips, T frames, S cells, n vocabularies of V codes.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rsjax.config import SampleConfig

Logits = dict[str, Float[Array, "B T S n V"]]


def copies(sample: SampleConfig) -> int:
    """Returns how many times a pass covers each clip."""
    if sample.guidance == 1:
        return 1
    return 2


def doubled(sample: SampleConfig, inputs: Any, clips: int) -> tuple[Any, Bool[Array, " 2B"] | None]:
    """Returns a pass's inputs twice, and True for the clips without actions; without guidance, the inputs and None."""
    if sample.guidance == 1:
        return inputs, None
    twice = jax.tree.map(lambda x: jnp.concatenate([x, x]), inputs)
    return twice, jnp.arange(2 * clips) >= clips


def guided(sample: SampleConfig, logits: Logits, strength: Float[Array, " B"] | None) -> Logits:
    """Returns the guided logits of a pass over :func:`doubled` inputs; without guidance, the logits.

    Args:
        strength: g of each clip instead of ``sample.guidance``, which still decides whether there is guidance.
    """
    if sample.guidance == 1:
        return logits
    g: Any = sample.guidance
    if strength is not None:
        g = strength[:, None, None, None, None]
    out = {}
    for branch, x in logits.items():
        with_actions, without = jnp.split(x, 2)
        out[branch] = without + g * (with_actions - without)
    return out
