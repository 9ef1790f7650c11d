"""Rollouts: generate tokens frame by frame from prompt frames and actions (paper Eq. 1).

With the temporal cache a frame takes ``steps`` passes over its cells, and one more to commit it with its final tokens.
The commit of frame t-1 is fused with the first step of frame t; the last commit is skipped. What a pass with masked
cells writes into the cache is overwritten before it is read, so cached and uncached rollouts agree.

A rollout may be longer than ``arch.frames``; ``window.py`` describes which frames it remembers. One program is compiled
for each number of clips, each number of prompt frames and each length, rounded up to a multiple of ``arch.frames``.
Arrays grow with that multiple, programs do not.

Axes: B clips, T frames (the first P are the prompt), H×W = S cells, D code bits, A action dimensions.
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
from rsjax.config import SampleConfig
from rsjax.layers.unstacked_params import apart
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.decode import Cells, Decoder, Means
from rsjax.models.roboscape.guidance import apply_guided, guided_cache, repeat_cache
from rsjax.models.roboscape.transformer import Cache, StackedCache
from rsjax.models.roboscape.window import cache_slots, room, stride, window_actions, window_start
from rsjax.tokenizers import lfq
from rsjax.trainable import Params

Tokens = dict[str, Int[Array, "B T H W"]]
Decoded = dict[str, Int[Array, "B T H W"] | Float[Array, "B T H W D"]]  # tokens, or codes if ``sample.shows_means``


@struct.dataclass
class Prompt:
    """Prompt frames encoded by :func:`encode_prompt`, from which any number of rollouts may start."""

    tokens: Tokens
    actions: Float[Array, "B P A"]
    cache: StackedCache  # of all frames but the last ``Architecture.uncommitted``
    no_depth: Bool[Array, " B"] | None  # as for :func:`rollout`
    # Settings that the cache depends on and a rollout must share; the stride is resolved.
    guided: bool = struct.field(pytree_node=False)
    window_stride: int = struct.field(pytree_node=False)
    cache_dtype: str = struct.field(pytree_node=False)

    def check(self, arch: Architecture, sample: SampleConfig) -> None:
        """Raises :class:`ValueError` if a rollout with ``sample`` cannot use this cache."""
        for name, wanted in _made_with(arch, sample).items():
            if (made := getattr(self, name)) != wanted:
                raise ValueError(
                    f"the prompt was encoded with {name} = {made!r}, the rollout has {wanted!r}; encode anew"
                )


def rollout(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    prompt: Tokens,
    actions: Float[Array, "B T A"],
    key: Key[Array, ""],
    cached: bool = True,
    index: Int[Array, " B"] | None = None,
    no_depth: Bool[Array, " B"] | None = None,
) -> Decoded:
    """Generates the frames after the prompt.

    Args:
        prompt: the tokens of P frames by branch. If "depth" is missing for a model with that branch, no clip has depth.
        actions: of all T frames, normalised; row t led into frame t, row 0 has no effect on the generated frames.
        key: of the random draws; the draws do not depend on actions.
        cached: False recomputes all frames of the window at every step, for comparison.
        index: each clip's number, which decides its draws together with ``key``; 0, 1, … by default.
        no_depth: True for clips without depth; None: all have depth. Such clips' depth is masked in every frame, as in
            training, and zeros in the result.

    Returns:
        Tokens of all T frames by branch; the first P are the prompt. If ``sample.shows_means``, the prompt's codes and
        the others' mean codes instead, from which the tokenizer can decode pictures too.

    Raises:
        ConfigError: the model does not support these settings.
        ValueError: T leaves nothing to generate; prompt, actions and ``no_depth`` differ in their number of clips; or
            the prompt lacks depth tokens of clips with depth.
    """
    arch.check_sampling(sample)
    clips, past = prompt["rgb"].shape[:2]
    _check_lengths(past, actions.shape[1])
    if clips != len(actions):
        raise ValueError(f"{clips} prompts and {len(actions)} action sequences; encode_prompt shares one among many")
    start, no_depth = _start(arch, prompt, no_depth)
    arguments = _arguments(arch, sample, actions, key, index)
    tokens = _rollout(arch, replace(sample, seed=0), cached, params, start, no_depth, *arguments)
    return {name: grid[:, : actions.shape[1]] for name, grid in tokens.items()}


def encode_prompt(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    prompt: Tokens,
    actions: Float[Array, "B P A"],
    no_depth: Bool[Array, " B"] | None = None,
) -> Prompt:
    """Encodes a prompt for :func:`rollout_from`.

    Args:
        prompt: tokens by branch, as for :func:`rollout`.
        actions: those that led into the prompt's frames, normalised.
        no_depth: as for :func:`rollout`.

    Raises:
        ConfigError: the model does not support these settings.
        ValueError: ``no_depth`` has another number of clips, or the prompt lacks depth tokens of clips with depth.
    """
    arch.check_sampling(sample)
    start, no_depth = _start(arch, prompt, no_depth)
    return _encode_jit(arch, replace(sample, seed=0), params, start, no_depth, actions)


def rollout_from(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    prompt: Prompt,
    actions: Float[Array, "N F A"],
    key: Key[Array, ""],
    index: Int[Array, " N"] | None = None,
) -> Decoded:
    """Generates the F frames after an encoded prompt, under N action sequences.

    Args:
        prompt: of N clips, or of one clip that all start from.
        actions: those that lead into the F frames, normalised.
        key: as for :func:`rollout`.
        index: as for :func:`rollout`; clips with the same number have the same draws.

    Returns:
        All P + F frames by branch, the same as from :func:`rollout` with the prompt repeated.

    Raises:
        ConfigError: the model does not support these settings.
        ValueError: F is 0; the prompt has neither one clip nor N; or it was encoded with other settings of guidance
            (on or off), window stride or cache type.
    """
    arch.check_sampling(sample)
    prompt.check(arch, sample)
    (clips, past), n = prompt.actions.shape[:2], len(actions)
    _check_lengths(past, past + actions.shape[1])
    if clips not in (1, n):
        raise ValueError(f"a prompt of {clips} clips and {n} action sequences; give one prompt, or as many")
    before = jnp.broadcast_to(prompt.actions, (n, *prompt.actions.shape[1:]))
    arguments = _arguments(arch, sample, jnp.concatenate([before, actions], axis=1), key, index)
    tokens = _resume(arch, replace(sample, seed=0), params, prompt, *arguments)
    return {name: grid[:, : past + actions.shape[1]] for name, grid in tokens.items()}


def _made_with(arch: Architecture, sample: SampleConfig) -> dict[str, Any]:
    """Returns the settings that a prompt's cache depends on."""
    return {
        "guided": sample.guidance != 1,
        "window_stride": stride(arch, sample),
        "cache_dtype": sample.cache_dtype,
    }


def _start(arch: Architecture, prompt: Tokens, no_depth: Any) -> tuple[Tokens, Array | None]:
    """Checks and returns the prompt's tokens of the model's branches, and ``no_depth`` if the model needs it."""
    if not arch.use_depth:
        return {"rgb": prompt["rgb"]}, None
    clips = len(prompt["rgb"])
    if no_depth is not None and np.shape(no_depth) != (clips,):
        raise ValueError(f"no_depth has shape {np.shape(no_depth)}; the prompt has {clips} clips, each needs one value")
    if "depth" in prompt:
        if isinstance(no_depth, np.ndarray) and not no_depth.any():  # the program without it is smaller
            no_depth = None
        return {name: prompt[name] for name in arch.branches}, no_depth
    if no_depth is not None and not np.all(no_depth):
        raise ValueError('no_depth says that clips have depth, but the prompt has no tokens "depth"')
    return {"rgb": prompt["rgb"], "depth": jnp.zeros_like(prompt["rgb"])}, jnp.ones(clips, bool)


def _check_lengths(past: int, frames: int) -> None:
    if not 0 < past < frames:
        raise ValueError(f"{frames} frames with a prompt of {past}; a rollout needs a prompt and a frame to generate")


def _arguments(arch: Architecture, sample: SampleConfig, actions: Array, key: Array, index: Array | None) -> tuple:
    """Returns actions padded to the size of the arrays, the number of frames as an array, and a key per clip."""
    b, frames, _ = actions.shape
    index = jnp.arange(b) if index is None else jnp.asarray(index)
    spare = room(arch, sample, frames) - frames
    keys = jax.vmap(partial(jax.random.fold_in, key))(index)
    return jnp.pad(actions, ((0, 0), (0, spare), (0, 0))), jnp.asarray(frames), keys


@partial(jax.jit, static_argnums=(0, 1, 2))
def _rollout(
    arch: Architecture,
    sample: SampleConfig,
    cached: bool,
    params: Params,
    prompt: Tokens,
    no_depth: Array | None,
    actions: Array,
    frames: Array,
    keys: Array,
) -> Decoded:
    past = prompt["rgb"].shape[1]
    apply = partial(apply_guided, arch, sample, _apart(arch, params), no_depth=no_depth)
    decoder = Decoder(arch, sample, apply, actions, keys, no_depth)
    tokens = _tokens(prompt, actions)
    if cached:
        start = _encode(arch, sample, params, prompt, no_depth, actions[:, :past])
        return _decode_cached(decoder, tokens, start.cache, past, frames)
    made = jax.lax.fori_loop(past, frames, decoder.uncached, (tokens, _means(decoder, tokens)))
    return _decoded(decoder, *made)


@partial(jax.jit, static_argnums=(0, 1))
def _resume(
    arch: Architecture, sample: SampleConfig, params: Params, prompt: Prompt, actions: Array, frames: Array, keys: Array
) -> Decoded:
    (clips, past), n = prompt.actions.shape[:2], len(actions)
    no_depth = None if prompt.no_depth is None else jnp.broadcast_to(prompt.no_depth, n)
    apply = partial(apply_guided, arch, sample, _apart(arch, params), no_depth=no_depth)
    decoder = Decoder(arch, sample, apply, actions, keys, no_depth)
    cache = prompt.cache if clips == n else repeat_cache(sample, prompt.cache, n)
    return _decode_cached(decoder, _tokens(prompt.tokens, actions), cache, past, frames)


def _encode(
    arch: Architecture, sample: SampleConfig, params: Params, prompt: Tokens, no_depth: Array | None, actions: Array
) -> Prompt:
    b, past = prompt["rgb"].shape[:2]
    cache: Any = guided_cache(arch, sample, b, cache_slots(arch, past))
    base = int(window_start(arch, sample, past))
    if (known := past - arch.uncommitted - base) > 0:
        tokens = {name: grid[:, base : base + known].reshape(b, known, -1) for name, grid in prompt.items()}
        seen = window_actions(arch, actions, base, base, known)
        mask = jnp.zeros((b, known, arch.grid**2), bool)
        _, cache = apply_guided(arch, sample, params, tokens, mask, seen, 0, cache, no_depth)
    return Prompt(prompt, actions, cache, no_depth, **_made_with(arch, sample))


_encode_jit = jax.jit(_encode, static_argnums=(0, 1))


def _apart(arch: Architecture, params: Params) -> Params:
    return params | {"blocks": apart(params["blocks"], arch.blocks, arch.unroll)}


def _decode_cached(decoder: Decoder, tokens: Cells, cache: StackedCache, past: int, frames: Array) -> Decoded:
    """Decodes frames ``past`` to ``frames`` - 1, window by window, with the cache of the first of these windows."""
    arch, sample, length = decoder.arch, decoder.sample, decoder.actions.shape[1]
    made = (tokens, _means(decoder, tokens), apart(cache, arch.blocks, arch.unroll))
    if arch.departures.rotary or length <= arch.frames:
        return _decoded(decoder, *jax.lax.fori_loop(past, frames, partial(decoder.cached, 0), made)[:2])
    by, first = stride(arch, sample), window_start(arch, sample, past)

    def window(number: Array, carry: tuple[Cells, Means, Cache]) -> tuple[Cells, Means, Cache]:
        base, later = number * by, number * by > first
        carry = jax.lax.cond(later, partial(decoder.encode_anew, base), lambda kept: kept, carry)
        begin = jnp.where(later, base + arch.frames - by, past)
        end = jnp.minimum(base + arch.frames, frames)
        return jax.lax.fori_loop(begin, end, partial(decoder.cached, base), carry)

    last = window_start(arch, sample, frames - 1)
    return _decoded(decoder, *jax.lax.fori_loop(first // by, last // by + 1, window, made)[:2])


def _tokens(prompt: Tokens, actions: Array) -> Cells:
    """Returns the prompt's tokens for every action sequence, padded with zeros for the frames to generate."""
    (b, length), out = actions.shape[:2], {}
    for name, grid in prompt.items():
        cells = grid.astype(jnp.int32).reshape(*grid.shape[:2], -1)
        cells = jnp.broadcast_to(cells, (b, *cells.shape[1:]))
        out[name] = jnp.pad(cells, ((0, 0), (0, length - cells.shape[1]), (0, 0)))
    return out


def _means(decoder: Decoder, tokens: Cells) -> Means:
    """Returns the prompt's codes, padded like its tokens; empty if frames are decoded from tokens."""
    if not decoder.sample.shows_means:
        return {}
    return {name: lfq.tokens_to_codes(cells, decoder.arch.code_bits) for name, cells in tokens.items()}


def _decoded(decoder: Decoder, tokens: Cells, means: Means) -> Decoded:
    """Returns the grids that pictures are decoded from, with zeros as depth of clips that have none."""
    made, grid, no_depth = means or tokens, decoder.arch.grid, decoder.no_depth
    out = {name: cells.reshape(*cells.shape[:2], grid, grid, *cells.shape[3:]) for name, cells in made.items()}
    if no_depth is not None:
        out["depth"] = jnp.where(no_depth.reshape(-1, *[1] * (out["depth"].ndim - 1)), 0, out["depth"])
    return out
