"""Lets the model train on its own predicted frames, as it reads them in a rollout (scheduled sampling in parallel).

A rollout reads frames that the model predicted, not true ones. If frames are masked as a whole, a single pass predicts
all frames of a clip, each from the true frame before it, and the mean codes of that pass stand in for those of a
rollout (arXiv 1906.04331, "Parallel Scheduled Sampling", with mean codes instead of drawn tokens).

With ``model.corruption``, some tokens of the "true" frames are random: they are those that the network reads.

Axes: B clips, T frames, S cells, D code bits.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rsjax.config import Departures
from rsjax.models.roboscape.departures.read_previous import frame_before
from rsjax.tokenizers import lfq

Previous = dict[str, Float[Array, "B T S D"]]


def conditions_itself(departures: Departures, key: Array, step: Int[Array, ""]) -> Bool[Array, ""]:
    """Draws whether a step reads the model's own frames; never before step ``self_conditioning_after``.

    Args:
        key: the step's key, the same on all devices.
    """
    drawn = jax.random.bernoulli(jax.random.fold_in(key, 3), departures.self_conditioning)
    return drawn & (step >= departures.self_conditioning_after)


def previous_frames(
    predict: Callable[[], tuple[dict[str, Float[Array, "B T S n V"]], Any]],
    tokens: dict[str, Int[Array, "B T H W"]],
    code_bits: int,
    own: Bool[Array, ""] | bool,
    prompt_frames: int,
) -> Previous:
    """Returns the codes of the frame before each frame: the true ones, or if ``own`` the model's mean codes.

    The prompt's frames stay true, as in a rollout. No gradient flows into the predictions. With ``model.corruption``
    the true frames are corrupted ones, the prompt's too.

    Args:
        predict: the network on the true frames: returns its logits and its cache; not computed unless ``own``.
        tokens: of the true frames, corrupted as the network reads them, by modality.
        own: whether to return the model's codes; the same on all devices.
        prompt_frames: those that generation starts from.
    """
    cells = {name: grid.reshape(*grid.shape[:2], -1) for name, grid in tokens.items()}
    true = {name: lfq.tokens_to_codes(grid, code_bits) for name, grid in cells.items()}

    def predicted() -> Previous:
        logits, _ = predict()
        means = {name: lfq.mean_codes(logits[name], code_bits) for name in tokens}
        joined = partial(jnp.concatenate, axis=1)
        return {name: joined([true[name][:, :prompt_frames], mean[:, prompt_frames:]]) for name, mean in means.items()}

    read: Any = jax.lax.cond(own, predicted, lambda: true)
    return {name: jax.lax.stop_gradient(frame_before(codes)) for name, codes in read.items()}
