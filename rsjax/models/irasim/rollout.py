"""Generates latents chunk by chunk: each chunk continues the last frames of the chunk before.

Axes: B clips, T frames, P prompt frames, F frames of a chunk, h×w cells of latents with C channels, A action inputs.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from rsjax.data.normalization import with_sums
from rsjax.devices import divide
from rsjax.models.diffusion.samplers import denoise, sampler_coefficients
from rsjax.models.irasim.config import IRASimConfig
from rsjax.models.irasim.dit import Architecture, DiT
from rsjax.trainable import Params


def rollout(
    arch: Architecture,
    config: IRASimConfig,
    shared: int,
    params: Params,
    prompt: Float[np.ndarray, "B P h w C"],
    actions: Float[np.ndarray, "B T A"],
    index: Int[np.ndarray, " B"],
) -> Float[np.ndarray, "B T h w C"]:
    """Returns the latents of T frames, of which the first P are the prompt's.

    Args:
        shared: frames that a chunk has in common with the chunk before, or with the prompt.
        actions: normalised, without sums; row t leads to frame t.
        index: each clip's number, which determines its noise.
    """
    frames = actions.shape[1]
    made = prompt
    number = 0
    shared = min(shared, prompt.shape[1])
    while made.shape[1] < frames:
        first = made.shape[1] - shared
        rows = actions[:, first : first + arch.frames]
        # As in the public code, the actions of a short last chunk are padded with its first action.
        rows = np.concatenate([rows, np.repeat(rows[:, 1:2], arch.frames - rows.shape[1], axis=1)], axis=1)
        rows[:, 0] = 0.0  # the sums begin here, as in a training clip
        sums = None
        if arch.integrate_actions:
            sums = np.cumsum(rows, axis=1)
        rows = with_sums(rows, sums)
        key = jax.random.fold_in(jax.random.key(config.sample.seed), number)
        batch = divide((made[:, first:], rows, index), params)
        chunk = _chunk(arch, config, params, key, *batch)
        made = np.concatenate([made, np.asarray(chunk)[:, shared:]], axis=1)
        number += 1
    return made[:, :frames]


@partial(jax.jit, static_argnums=(0, 1))
def _chunk(
    arch: Architecture,
    config: IRASimConfig,
    params: Params,
    key: Key[Array, ""],
    known: Float[Array, "B K h w C"],
    actions: Float[Array, "B F A"],
    index: Int[Array, " B"],
) -> Float[Array, "B F h w C"]:
    """Returns a chunk whose first K frames are known and stay as they are."""
    shape = (arch.frames, *known.shape[2:])
    past = known.shape[1]
    start = jax.vmap(lambda number: jax.random.normal(jax.random.fold_in(key, number), shape))(index)

    def predict(x: Float[Array, "B F h w C"], t: Int[Array, ""]) -> Float[Array, "B F h w C"]:
        return DiT(arch).apply({"params": params}, x, jnp.full(len(x), t), actions)  # type: ignore[return-value]

    coefficients = sampler_coefficients(config.noise, config.sample)
    return denoise(coefficients, predict, start, lambda x: x.at[:, :past].set(known))
