"""The model in a rollout, guided by its actions where that is asked for (classifier-free guidance).

Guided, every pass is one over twice the clips: with their actions, then without; so is the cache.

Axes: B clips, T frames, S cells, A action dimensions, n vocabularies of V codes.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from rsjax.clip import Array
from rsjax.config import ModelConfig, SampleConfig
from rsjax.models.roboscape.world_model import Cache, WorldModel, empty_cache


def apply_guided(
    model: ModelConfig,
    sample: SampleConfig,
    params: Any,
    tokens: dict[str, Int[Array, "B T S"]],
    mask: Bool[Array, "B T S"],
    actions: Float[Array, "B T A"],
    start: Any,
    cache: Cache | None,
    no_depth: Bool[Array, " B"] | None = None,
) -> tuple[dict[str, Float[Array, "B T S n V"]], Cache | None]:
    """Logits without + g·(with - without the actions), g = ``sample.guidance``; and the cache.

    Args:
        start: position of the first given frame (may be traced).
        cache: from :func:`guided_cache` or an earlier call.
        no_depth: True for clips whose depth is hidden, as in :class:`rsjax.models.roboscape.world_model.WorldModel`.
    """
    if sample.guidance == 1:
        return _apply(model, params, tokens, mask, actions, start, cache, None, no_depth)
    b = len(mask)
    twice = lambda x: jnp.concatenate([x, x])  # noqa: E731
    drop = jnp.arange(2 * b) >= b
    tokens, mask, actions, no_depth = jax.tree.map(twice, (tokens, mask, actions, no_depth))
    logits, cache = _apply(model, params, tokens, mask, actions, start, cache, drop, no_depth)
    return {name: x[b:] + sample.guidance * (x[:b] - x[b:]) for name, x in logits.items()}, cache


def guided_cache(model: ModelConfig, sample: SampleConfig, batch: int, slots: int) -> Cache:
    """An empty cache for :func:`apply_guided`."""
    return empty_cache(model, _copies(sample) * batch, slots, jnp.dtype(sample.cache_dtype))


def repeat_cache(sample: SampleConfig, cache: Cache, clips: int) -> Cache:
    """The cache of one clip as that of ``clips`` clips that all begin with it."""

    def repeat(x: Float[Array, "L c S h N e"]) -> Float[Array, "L cB S h N e"]:
        shape = (len(x), _copies(sample), clips, *x.shape[2:])
        return jnp.broadcast_to(x[:, :, None], shape).reshape(len(x), -1, *x.shape[2:])

    return jax.tree.map(repeat, cache)


def _copies(sample: SampleConfig) -> int:
    return 1 if sample.guidance == 1 else 2


def _apply(
    model: ModelConfig,
    params: Any,
    tokens: Any,
    mask: Any,
    actions: Any,
    start: Any,
    cache: Any,
    drop: Any,
    no_depth: Any,
) -> Any:
    shape = (*mask.shape[:2], model.grid, model.grid)
    grids = {name: cells.reshape(shape) for name, cells in tokens.items()}
    inputs = (grids, mask.reshape(shape), actions, start, cache)
    return WorldModel(model).apply({"params": params}, *inputs, drop, no_depth)
