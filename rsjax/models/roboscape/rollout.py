"""Rollouts: from prompt frames and actions to the tokens of every frame, frame by frame (paper Eq. 1).

With the temporal cache a frame costs ``steps`` frame passes and its commit one: the commit of frame t-1 (a pass with
its final tokens) is fused with the first step of frame t, and the last commit is skipped. What a pass with masked cells
writes into the cache is overwritten before anything reads it, so cached and uncached rollouts agree.

A rollout may be longer than ``model.frames``; ``window.py`` says what a frame then remembers. For a number
of clips and of prompt frames, one program serves all lengths up to ``model.frames``, and another one those up to each
further multiple of it: one compilation per multiple. Their arrays grow with the multiple, the programs do not.

Axes: B clips, T frames (P of them given), H×W = S cells, A action dimensions.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Int, Key

from rsjax.clip import Array
from rsjax.config import ModelConfig, SampleConfig
from rsjax.models.roboscape.decode import Decoder
from rsjax.models.roboscape.guidance import apply_guided, guided_cache, repeat_cache
from rsjax.models.roboscape.window import cache_slots, room, stride, window_actions, window_start
from rsjax.models.roboscape.world_model import Cache, branches

Tokens = dict[str, Int[Array, "B T H W"]]


@struct.dataclass
class Prompt:
    """Given frames, encoded once, from which any number of rollouts may start. From :func:`encode_prompt`."""

    tokens: Tokens
    actions: Float[Array, "B P A"]
    cache: Cache  # of all frames but the last, whose commit is fused with the next frame's first step
    no_depth: Bool[Array, " B"] | None  # as of :func:`rollout`; it holds for all that follows too
    # What the cache was made with, as SampleConfig has it; the stride resolved. Rollouts from here must agree.
    guided: bool = struct.field(pytree_node=False)
    window_stride: int = struct.field(pytree_node=False)
    cache_dtype: str = struct.field(pytree_node=False)

    def check(self, model: ModelConfig, sample: SampleConfig) -> None:
        """Raises :class:`ValueError` where a rollout with ``sample`` could not go on from this cache."""
        for name, wanted in _made_with(model, sample).items():
            if (made := getattr(self, name)) != wanted:
                raise ValueError(
                    f"the prompt was encoded with {name} = {made!r}, the rollout has {wanted!r}; encode anew"
                )


def rollout(
    model: ModelConfig,
    sample: SampleConfig,
    params: Any,
    prompt: Tokens,
    actions: Float[Array, "B T A"],
    key: Key[Array, ""],
    cached: bool = True,
    index: Int[Array, " B"] | None = None,
    no_depth: Bool[Array, " B"] | None = None,
) -> Tokens:
    """Generates the frames after the prompt.

    Args:
        prompt: the given frames' tokens by branch, P of them. Without "depth", for a model that has that branch: no
            clip has depth.
        actions: of all T frames, normalised; row t led into frame t, row 0 is not read by anything that matters.
        key: of the draws; the same key with other actions draws alike.
        cached: False recomputes all frames of the window at every step, for comparison.
        index: each clip's number, which with ``key`` decides its draws; 0, 1, … if not given.
        no_depth: True for clips without depth, None where all have it. Their depth stays hidden from the first frame to
            the last, as in training, and is nothing but zeros in what is returned.

    Returns:
        Tokens of all T frames by branch; the first P are the prompt's.

    Raises:
        ConfigError: the model cannot be sampled like this.
        ValueError: T leaves nothing to generate; prompt, actions and ``no_depth`` are of different numbers of clips; or
            the prompt lacks the depth of clips that have it.
    """
    sample.check(model)
    clips, given = prompt["rgb"].shape[:2]
    _check_lengths(given, actions.shape[1])
    if clips != len(actions):
        raise ValueError(f"{clips} prompts and {len(actions)} action sequences; encode_prompt shares one among many")
    start, no_depth = _start(model, prompt, no_depth)
    arguments = _arguments(model, sample, actions, key, index)
    tokens = _rollout(model, replace(sample, seed=0), cached, params, start, no_depth, *arguments)
    return {name: grid[:, : actions.shape[1]] for name, grid in tokens.items()}


def encode_prompt(
    model: ModelConfig,
    sample: SampleConfig,
    params: Any,
    prompt: Tokens,
    actions: Float[Array, "B P A"],
    no_depth: Bool[Array, " B"] | None = None,
) -> Prompt:
    """Runs the prompt once, for :func:`rollout_from`.

    Args:
        prompt: the given frames' tokens by branch, as for :func:`rollout`.
        actions: that led into them, normalised.
        no_depth: as for :func:`rollout`.

    Raises:
        ConfigError: the model cannot be sampled like this.
        ValueError: ``no_depth`` is of another number of clips, or the prompt lacks the depth of clips that have it.
    """
    sample.check(model)
    start, no_depth = _start(model, prompt, no_depth)
    return _encode_jit(model, replace(sample, seed=0), params, start, no_depth, actions)


def rollout_from(
    model: ModelConfig,
    sample: SampleConfig,
    params: Any,
    prompt: Prompt,
    actions: Float[Array, "N F A"],
    key: Key[Array, ""],
    index: Int[Array, " N"] | None = None,
) -> Tokens:
    """Generates the F frames after an encoded prompt, under N action sequences.

    Args:
        prompt: of N clips, or of one that all start from.
        actions: that lead into the F frames, normalised.
        key: as for :func:`rollout`.
        index: as for :func:`rollout`; equal numbers draw alike, so that candidates differ in their actions alone.

    Returns:
        Tokens of all P + F frames by branch, as :func:`rollout` gives with each prompt repeated.

    Raises:
        ConfigError: the model cannot be sampled like this.
        ValueError: F is 0, the prompt is neither of one clip nor of N, or it was encoded with guidance where there is
            none now (or the other way about), with another window stride or another type of cache.
    """
    sample.check(model)
    prompt.check(model, sample)
    (clips, given), n = prompt.actions.shape[:2], len(actions)
    _check_lengths(given, given + actions.shape[1])
    if clips not in (1, n):
        raise ValueError(f"a prompt of {clips} clips and {n} action sequences; give one prompt, or as many")
    before = jnp.broadcast_to(prompt.actions, (n, *prompt.actions.shape[1:]))
    arguments = _arguments(model, sample, jnp.concatenate([before, actions], axis=1), key, index)
    tokens = _resume(model, replace(sample, seed=0), params, prompt, *arguments)
    return {name: grid[:, : given + actions.shape[1]] for name, grid in tokens.items()}


def _made_with(model: ModelConfig, sample: SampleConfig) -> dict[str, Any]:
    """What decides the shape, the type and the frames of a prompt's cache."""
    return {
        "guided": sample.guidance != 1,
        "window_stride": stride(model, sample),
        "cache_dtype": sample.cache_dtype,
    }


def _start(model: ModelConfig, prompt: Tokens, no_depth: Any) -> tuple[Tokens, Array | None]:
    """The prompt's tokens of the branches that the model has, and ``no_depth`` where the model reads it."""
    if not model.depth:
        return {"rgb": prompt["rgb"]}, None
    clips = len(prompt["rgb"])
    if no_depth is not None and np.shape(no_depth) != (clips,):
        raise ValueError(f"no_depth has shape {np.shape(no_depth)}; the prompt has {clips} clips, each needs one value")
    if "depth" in prompt:
        if isinstance(no_depth, np.ndarray) and not no_depth.any():  # the program without it is the smaller one
            no_depth = None
        return {name: prompt[name] for name in branches(model)}, no_depth
    if no_depth is not None and not np.all(no_depth):
        raise ValueError('no_depth says that clips have depth, but the prompt has no tokens "depth"')
    return {"rgb": prompt["rgb"], "depth": jnp.zeros_like(prompt["rgb"])}, jnp.ones(clips, bool)


def _check_lengths(given: int, frames: int) -> None:
    if not 0 < given < frames:
        raise ValueError(f"{frames} frames asked for with {given} given; at least one must be given and one left")


def _arguments(model: ModelConfig, sample: SampleConfig, actions: Array, key: Array, index: Array | None) -> tuple:
    """Actions with room to spare, the number of frames as a value instead of a shape, and a key per clip."""
    b, frames, _ = actions.shape
    index = jnp.arange(b) if index is None else jnp.asarray(index)
    spare = room(model, sample, frames) - frames
    keys = jax.vmap(partial(jax.random.fold_in, key))(index)
    return jnp.pad(actions, ((0, 0), (0, spare), (0, 0))), jnp.asarray(frames), keys


@partial(jax.jit, static_argnums=(0, 1, 2))
def _rollout(
    model: ModelConfig,
    sample: SampleConfig,
    cached: bool,
    params: Any,
    prompt: Tokens,
    no_depth: Array | None,
    actions: Array,
    frames: Array,
    keys: Array,
) -> Tokens:
    given = prompt["rgb"].shape[1]
    apply = partial(apply_guided, model, sample, params, no_depth=no_depth)
    decoder = Decoder(model, sample, apply, actions, keys, no_depth)
    tokens = _tokens(prompt, actions)
    if cached:
        start = _encode(model, sample, params, prompt, no_depth, actions[:, :given])
        return _grids(model, _decode_cached(decoder, tokens, start.cache, given, frames), no_depth)
    tokens = jax.lax.fori_loop(given, frames, decoder.uncached, tokens)
    return _grids(model, tokens, no_depth)


@partial(jax.jit, static_argnums=(0, 1))
def _resume(
    model: ModelConfig, sample: SampleConfig, params: Any, prompt: Prompt, actions: Array, frames: Array, keys: Array
) -> Tokens:
    (clips, given), n = prompt.actions.shape[:2], len(actions)
    no_depth = None if prompt.no_depth is None else jnp.broadcast_to(prompt.no_depth, n)
    apply = partial(apply_guided, model, sample, params, no_depth=no_depth)
    decoder = Decoder(model, sample, apply, actions, keys, no_depth)
    cache = prompt.cache if clips == n else repeat_cache(sample, prompt.cache, n)
    return _grids(model, _decode_cached(decoder, _tokens(prompt.tokens, actions), cache, given, frames), no_depth)


def _encode(
    model: ModelConfig, sample: SampleConfig, params: Any, prompt: Tokens, no_depth: Array | None, actions: Array
) -> Prompt:
    b, given = prompt["rgb"].shape[:2]
    cache: Any = guided_cache(model, sample, b, cache_slots(model, given))
    base = int(window_start(model, sample, given))
    if (known := given - 1 - base) > 0:
        tokens = {name: grid[:, base : given - 1].reshape(b, known, -1) for name, grid in prompt.items()}
        seen = window_actions(model, actions, base, base, known)
        mask = jnp.zeros((b, known, model.grid**2), bool)
        _, cache = apply_guided(model, sample, params, tokens, mask, seen, 0, cache, no_depth)
    return Prompt(prompt, actions, cache, no_depth, **_made_with(model, sample))


_encode_jit = jax.jit(_encode, static_argnums=(0, 1))


def _decode_cached(decoder: Decoder, tokens: dict, cache: Cache, given: int, frames: Array) -> dict:
    """Frames ``given`` to ``frames`` - 1, window by window; the cache is that of the first of these windows."""
    model, sample, length = decoder.model, decoder.sample, decoder.actions.shape[1]
    if model.positions == "rotary" or length <= model.frames:
        return jax.lax.fori_loop(given, frames, partial(decoder.cached, 0), (tokens, cache))[0]
    by, first = stride(model, sample), window_start(model, sample, given)

    def window(number: Array, carry: tuple[dict, Cache]) -> tuple[dict, Cache]:
        base, later = number * by, number * by > first
        carry = jax.lax.cond(later, partial(decoder.encode_anew, base), lambda kept: kept, carry)
        begin = jnp.where(later, base + model.frames - by, given)
        end = jnp.minimum(base + model.frames, frames)
        return jax.lax.fori_loop(begin, end, partial(decoder.cached, base), carry)

    last = window_start(model, sample, frames - 1)
    return jax.lax.fori_loop(first // by, last // by + 1, window, (tokens, cache))[0]


def _tokens(prompt: Tokens, actions: Array) -> dict[str, Int[Array, "B T S"]]:
    """The prompt's tokens for every sequence of actions, and zeros for what is to come."""
    (b, length), out = actions.shape[:2], {}
    for name, grid in prompt.items():
        cells = grid.astype(jnp.int32).reshape(*grid.shape[:2], -1)
        cells = jnp.broadcast_to(cells, (b, *cells.shape[1:]))
        out[name] = jnp.pad(cells, ((0, 0), (0, length - cells.shape[1]), (0, 0)))
    return out


def _grids(model: ModelConfig, tokens: dict[str, Int[Array, "B T S"]], no_depth: Array | None) -> Tokens:
    if no_depth is not None:
        tokens = tokens | {"depth": jnp.where(no_depth[:, None, None], 0, tokens["depth"])}
    return {name: cells.reshape(*cells.shape[:2], model.grid, model.grid) for name, cells in tokens.items()}
