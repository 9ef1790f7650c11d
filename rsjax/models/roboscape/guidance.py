"""Applies the network in a rollout, with classifier-free guidance by actions if it is on.

With guidance, every pass and the cache cover all clips twice: first with their actions, then without.

Axes: B clips, T frames, S cells, A action dimensions, n vocabularies of V codes.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from rsjax.clip import Array
from rsjax.config import SampleConfig
from rsjax.layers.unstacked_params import together
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Cache, Cells, StackedCache, Transformer, empty_cache
from rsjax.trainable import Params


def apply_guided(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    tokens: dict[str, Cells],
    mask: Bool[Array, "B T S"],
    actions: Float[Array, "B T A"],
    start: Any,
    cache: Cache | None,
    no_depth: Bool[Array, " B"] | None = None,
    previous: dict[str, Cells] | None = None,
    strength: Float[Array, " B"] | None = None,
) -> tuple[dict[str, Float[Array, "B T S n V"]], Cache | None]:
    """Returns logits without + g·(with - without the actions), g = ``sample.guidance``, and the cache.

    Args:
        start: position of the first of these frames (may be traced).
        cache: from :func:`guided_cache` or an earlier call.
        no_depth: True for clips whose depth is hidden, as in :class:`rsjax.models.roboscape.transformer.Transformer`.
        previous: tokens of the frame before each of these, as in ``Transformer``.
        strength: g of each clip instead of ``sample.guidance``, which still decides whether there is guidance.
    """
    b, drop = len(mask), None
    if sample.guidance != 1:
        inputs = (tokens, mask, actions, no_depth, previous)
        tokens, mask, actions, no_depth, previous = jax.tree.map(lambda x: jnp.concatenate([x, x]), inputs)
        drop = jnp.arange(2 * b) >= b
    logits, cache = _apply(arch, params, tokens, mask, actions, start, cache, drop, no_depth, previous)
    if drop is not None:
        g = sample.guidance if strength is None else strength[:, None, None, None, None]
        logits = {name: x[b:] + g * (x[:b] - x[b:]) for name, x in logits.items()}
    return logits, cache


def guided_cache(arch: Architecture, sample: SampleConfig, batch: int, slots: int) -> StackedCache:
    """Returns an empty cache for :func:`apply_guided`."""
    return empty_cache(arch, _copies(sample) * batch, slots, jnp.dtype(sample.cache_dtype))


def repeat_cache(sample: SampleConfig, cache: StackedCache, clips: int) -> StackedCache:
    """Returns the cache of one clip repeated for ``clips`` clips."""

    def repeat(x: Float[Array, "L c S h N e"]) -> Float[Array, "L cB S h N e"]:
        shape = (len(x), _copies(sample), clips, *x.shape[2:])
        return jnp.broadcast_to(x[:, :, None], shape).reshape(len(x), -1, *x.shape[2:])

    return jax.tree.map(repeat, cache)


def _copies(sample: SampleConfig) -> int:
    return 1 if sample.guidance == 1 else 2


def _apply(
    arch: Architecture,
    params: Params,
    tokens: Any,
    mask: Any,
    actions: Any,
    start: Any,
    cache: Any,
    drop: Any,
    no_depth: Any,
    previous: Any,
) -> Any:
    shape = (*mask.shape[:2], arch.grid, arch.grid)
    grids = {name: cells.reshape(*shape, *cells.shape[3:]) for name, cells in tokens.items()}
    inputs = (grids, mask.reshape(shape), actions, start, cache)
    whole = params | {"blocks": together(params["blocks"])}
    return Transformer(arch).apply({"params": whole}, *inputs, drop, no_depth, previous)
