"""Lets the model train on its own predicted frames, as it reads them in a rollout (scheduled sampling in parallel).

A rollout reads frames that the model predicted, not true ones. If frames are masked as a whole, a single pass predicts
all frames of a clip, each from the true frame before it, and the mean codes of that pass stand in for those of a
rollout (arXiv 1906.04331, "Parallel Scheduled Sampling", with mean codes instead of drawn tokens).

Axes: B clips, T frames, S cells, D code bits.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rsjax.models.roboscape.transformer import shifted
from rsjax.tokenizers import lfq

Previous = dict[str, Float[Array, "B T S D"]]


def previous_frames(
    predict: Callable[[], dict[str, Float[Array, "B T S n V"]]],
    tokens: dict[str, Int[Array, "B T H W"]],
    code_bits: int,
    own: Bool[Array, ""] | bool,
    prompt_frames: int,
) -> Previous:
    """Returns the codes of the frame before each frame: the true ones, or if ``own`` the model's mean codes.

    The prompt's frames stay true, as in a rollout. No gradient flows into the predictions.

    Args:
        predict: returns the logits of all frames, each from the true frames before it; not computed unless ``own``.
        tokens: of the true frames, by branch.
        own: whether to return the model's codes; the same on all devices.
        prompt_frames: those that generation starts from.
    """
    true = {name: _codes(grid, code_bits) for name, grid in tokens.items()}

    def predicted() -> Previous:
        means = {name: lfq.mean_codes(logits, code_bits) for name, logits in predict().items()}
        joined = partial(jnp.concatenate, axis=1)
        return {name: joined([true[name][:, :prompt_frames], mean[:, prompt_frames:]]) for name, mean in means.items()}

    read: Any = jax.lax.cond(own, predicted, lambda: true)
    return {name: jax.lax.stop_gradient(shifted(codes)) for name, codes in read.items()}


def _codes(grid: Int[Array, "B T H W"], code_bits: int) -> Float[Array, "B T S D"]:
    return lfq.tokens_to_codes(grid.reshape(*grid.shape[:2], -1), code_bits)
