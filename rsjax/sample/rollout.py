"""Rollouts: from prompt frames and actions to the tokens of every frame, frame by frame (paper Eq. 1).

With the temporal cache a frame costs ``steps`` frame passes and its commit one: the commit of frame t-1 (a pass with
its final tokens) is fused with the first step of frame t, and the last commit is skipped. What a pass with masked cells
writes into the cache is overwritten before anything reads it, so cached and uncached rollouts agree.

Axes: B clips, T frames, H×W = S cells, A action dimensions.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rsjax.config import ModelConfig, SampleConfig
from rsjax.model.world_model import WorldModel, branches, empty_cache
from rsjax.sample.maskgit import Frame, unmask_step

Tokens = dict[str, Int[Array, "B T H W"]]


@partial(jax.jit, static_argnames=("model", "sample", "cached"))
def rollout(
    model: ModelConfig,
    sample: SampleConfig,
    params: Any,
    prompt: Tokens,
    actions: Float[Array, "B T A"],
    key: Array,
    cached: bool = True,
) -> Tokens:
    """Generates the frames after the prompt.

    Args:
        prompt: the given frames' tokens by branch, P of them.
        actions: of all T frames, normalised; row t led into frame t, row 0 is not read by anything that matters.
        key: of the draws; the same key with other actions draws alike.
        cached: False recomputes all frames at every step, for comparison.

    Returns:
        Tokens of all T frames by branch; the first P are the prompt's.

    Raises:
        ValueError: T exceeds the positions that the model has, or leaves nothing to generate.
    """
    names = branches(model)
    given, (b, frames, _) = prompt[names[0]].shape[1], actions.shape
    if not given < frames <= model.frames:
        raise ValueError(f"{frames} frames asked for with {given} given; the model holds positions for {model.frames}")
    pad = ((0, 0), (0, frames - given), (0, 0), (0, 0))
    tokens = {name: jnp.pad(prompt[name].astype(jnp.int32), pad).reshape(b, frames, -1) for name in names}
    cells = tokens[names[0]].shape[-1]
    apply = partial(_apply, model, params)
    decode = _decode_cached if cached else _decode_uncached

    cache = empty_cache(model, b, frames) if cached else None
    if cached and given > 1:
        start = {name: tokens[name][:, : given - 1] for name in names}
        _, cache = apply(start, jnp.zeros((b, given - 1, cells), bool), actions[:, : given - 1], 0, cache)

    def one_frame(t: Array, carry: tuple[dict[str, Array], Any]) -> tuple[dict[str, Array], Any]:
        tokens, cache = carry
        keys = jax.random.split(jax.random.fold_in(key, t), sample.steps)
        return decode(apply, sample, model.code_bits, keys, tokens, actions, t, cache)

    tokens, _ = jax.lax.fori_loop(given, frames, one_frame, (tokens, cache))
    return {name: grid.reshape(b, frames, model.grid, model.grid) for name, grid in tokens.items()}


def _apply(model: ModelConfig, params: Any, tokens: dict, mask: Array, actions: Array, start: Any, cache: Any) -> Any:
    shape = (*mask.shape[:2], model.grid, model.grid)
    grids = {name: cells.reshape(shape) for name, cells in tokens.items()}
    return WorldModel(model).apply({"params": params}, grids, mask.reshape(shape), actions, start, cache)


def _decode_cached(
    apply: Any, sample: SampleConfig, code_bits: int, keys: Array, tokens: dict, actions: Array, t: Array, cache: Any
) -> Any:
    """Frame t from the cache of frames before t-1: a pass over (t-1, t), then passes over t alone."""
    b, _, cells = next(iter(tokens.values())).shape
    pair = {name: jax.lax.dynamic_slice_in_dim(grid, t - 1, 2, axis=1) for name, grid in tokens.items()}
    mask = jnp.broadcast_to(jnp.array([False, True])[None, :, None], (b, 2, cells))
    logits, cache = apply(pair, mask, jax.lax.dynamic_slice_in_dim(actions, t - 1, 2, axis=1), t - 1, cache)
    frame = Frame({name: grid[:, 1] for name, grid in pair.items()}, mask[:, 1])
    frame = unmask_step(sample, code_bits, keys[0], 0, frame, {name: x[:, 1] for name, x in logits.items()})

    action = jax.lax.dynamic_slice_in_dim(actions, t, 1, axis=1)

    def step(i: Array, frame: Frame) -> Frame:
        one = {name: grid[:, None] for name, grid in frame.tokens.items()}
        logits, _ = apply(one, frame.mask[:, None], action, t, cache)
        return unmask_step(sample, code_bits, keys[i], i, frame, {name: x[:, 0] for name, x in logits.items()})

    frame = jax.lax.fori_loop(1, sample.steps, step, frame)
    return _put(tokens, frame, t), cache


def _decode_uncached(
    apply: Any, sample: SampleConfig, code_bits: int, keys: Array, tokens: dict, actions: Array, t: Array, cache: None
) -> Any:
    """Frame t from a full pass over all frames at every step."""
    b, frames, cells = next(iter(tokens.values())).shape
    frame = Frame({name: grid[:, 0] for name, grid in tokens.items()}, jnp.ones((b, cells), bool))

    def step(i: Array, frame: Frame) -> Frame:
        here = jnp.arange(frames)[None, :, None] == t
        logits, _ = apply(_put(tokens, frame, t), here & frame.mask[:, None], actions, 0, None)
        at_t = {name: jax.lax.dynamic_index_in_dim(x, t, axis=1, keepdims=False) for name, x in logits.items()}
        return unmask_step(sample, code_bits, keys[i], i, frame, at_t)

    frame = jax.lax.fori_loop(0, sample.steps, step, frame)
    return _put(tokens, frame, t), None


def _put(tokens: dict, frame: Frame, t: Array) -> dict:
    """The frame's tokens at place t."""
    return {
        name: jax.lax.dynamic_update_slice_in_dim(grid, frame.tokens[name][:, None], t, axis=1)
        for name, grid in tokens.items()
    }
