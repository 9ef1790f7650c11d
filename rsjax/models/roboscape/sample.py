"""Generation frame by frame (paper Eq. 1): each frame is decoded from those before it and the actions.

:func:`step` generates the next frame of some clips; :func:`rollout` repeats it. Within a frame, MaskGIT
(``maskgit.py``) decodes the cells in ``sample.steps`` passes of the network. A temporal cache holds keys and values of
the frames before. Frame t-1 enters it with its final tokens in the first pass of frame t; what a pass writes for masked
cells is overwritten before it is read. So cached rollouts equal those that recompute every pass.

**Windows.** A clip may be longer than the ``arch.frames`` positions. Rotary positions roll on with the clip. Learned
positions count from the window's first frame, so the cache is valid only while the window stays in place. When it is
full, it moves by a stride, and the frames that stay in it are encoded again.

Axes: B clips, P prompt frames, T frames, F of them generated, K frames kept, H×W = S cells, D code bits, A numbers per
frame that the action encoder reads, n vocabularies of V codes, L blocks.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Int, Key

from rsjax.clip import Array
from rsjax.config import SampleConfig
from rsjax.data.normalization import Normalization
from rsjax.layers.dense import rounded
from rsjax.layers.platform import where_launches_take_long
from rsjax.layers.unstacked_params import stack_params, unstack_params
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures import guidance, mean_codes, state_heads
from rsjax.models.roboscape.maskgit import Frame, unmask_step
from rsjax.models.roboscape.transformer import Cache, Cells, StackedCache, empty_cache, run_transformer, run_with_trunk
from rsjax.trainable import Params

ADDED_IN_BF16 = ("proj", "depth_to_rgb")  # layers that add their bias to features; the MLP's kernel adds it in float32

Tokens = dict[str, Int[Array, "B T H W"]]
# By branch, tokens, or codes if ``sample.shows_means``; and "state", what the state heads read, if the model has them.
Decoded = dict[str, Int[Array, "B T H W"] | Float[Array, "B T H W D"] | Float[Array, "B T K"]]


@struct.dataclass
class State:
    """B clips between two frames, all at the same position.

    Clips at different positions are a stack of N states of one clip each: arrays have another axis, as ``CLIPS`` says.

    Attributes:
        tokens: of the last K frames by branch.
        means: mean codes of these frames; empty unless ``sample.shows_means``.
        actions: those that lead into these frames, as in a whole clip's inputs (sums since its first frame).
        base: those that lead into the window's first frame, or with ``resting`` as many frames of rest as have left it.
        cache: of the window's frames except the last ``Architecture.uncommitted``.
        position: the next frame's position in its window.
        frame: the next frame's number in its clip.
        key: decides each clip's draws.
        no_depth: True for clips without depth, whose depth cells are masked; None: all clips have depth.
        temperature: of each clip, above 0, instead of that of ``sample``, which still decides whether tokens are drawn.
        guidance: of each clip instead of that of ``sample``, which still decides whether there is guidance.
        entropy: of the last frame's RGB tokens in nats; None: not requested.
        readings: what the state heads read from the last frame; None: the model has none.
        features: the RGB branch's features of the last frame in its first pass, which sees none of its cells, as means
            over the cells; None: not requested.
        resting: the actions of a frame of rest; None: sums begin at the window's first frame.
    """

    tokens: dict[str, Int[Array, "B K S"]]
    means: dict[str, Float[Array, "B K S D"]]
    actions: Float[Array, "B K A"]
    base: Float[Array, "B A"]
    cache: Cache
    position: Int[Array, ""]
    frame: Int[Array, ""]
    key: Key[Array, " B"] | None
    no_depth: Bool[Array, " B"] | None = None
    temperature: Float[Array, " B"] | None = None
    guidance: Float[Array, " B"] | None = None
    entropy: Float[Array, "B S"] | None = None
    readings: Float[Array, "B K"] | None = None
    features: Float[Array, "B C"] | None = None
    resting: Float[Array, "B A"] | None = None


# Axes of a stack of states; the blocks stay the cache's first axis.
_AXES: dict[str, Any] = {field.name: int(field.name == "cache") for field in fields(State)}
CLIPS: Any = State(**_AXES)


def clip_axes(state: State) -> Any:
    """Returns ``CLIPS``; of a state whose cache is a list of its blocks' parts, clips are the parts' first axis too."""
    if isinstance(state.cache, list):
        return replace(CLIPS, cache=0)
    return CLIPS


@struct.dataclass
class Prompt:
    """Prompt frames encoded by :func:`encode_prompt`, from which any number of rollouts may start."""

    tokens: dict[str, Int[Array, "B P S"]]
    state: State
    # Settings that the cache depends on and a rollout must share; the stride is resolved.
    settings: tuple[tuple[str, Any], ...] = struct.field(pytree_node=False)


def start(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    tokens: dict[str, Int[Array, "B P S"]],
    actions: Float[Array, "B P A"],
    key: Key[Array, " B"] | None,
    no_depth: Bool[Array, " B"] | None,
    resting: Float[Array, " A"] | None = None,
) -> State:
    """Encodes prompt frames, and returns the state before the first frame after them.

    Args:
        resting: as :func:`resting_actions` returns them.
    """
    clips, past = tokens["rgb"].shape[:2]
    base = int(window_start(arch, sample, past))
    if resting is not None:
        resting = jnp.broadcast_to(resting, (len(actions), len(resting)))
    before = sums_before(actions[:, base], base, resting)
    cache: Any = new_cache(arch, sample, clips, cache_slots(arch, past))
    known = slice(base, past - unread(arch))
    readings = None
    if known.stop > base:
        prompt_tokens = {branch: cells[:, known] for branch, cells in tokens.items()}
        mask = jnp.zeros(prompt_tokens["rgb"].shape, bool)
        rows = window_actions(arch, actions[:, known], before, 0)
        _, cache, trunk = apply_network(arch, sample, params, prompt_tokens, mask, rows, 0, cache, no_depth)
        readings = read_state(arch, params, trunk)

    kept = remembered_frames(arch, sample)

    def last(x: Array) -> Array:
        x = x[:, -kept:]
        return jnp.pad(x, [(0, 0), (kept - x.shape[1], 0), *[(0, 0)] * (x.ndim - 2)])

    return State(
        tokens=jax.tree.map(last, tokens),
        means=jax.tree.map(last, mean_codes.codes_of(sample, tokens, arch.code_bits)),
        actions=last(actions),
        base=before,
        cache=cache,
        position=jnp.asarray(past - base, jnp.int32),
        frame=jnp.asarray(past, jnp.int32),
        key=key,
        no_depth=no_depth,
        readings=readings,
        resting=resting,
    )


def step(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    state: State,
    actions: Float[Array, "B A"],
    beyond: bool = True,
) -> tuple[State, dict[str, Array]]:
    """Generates the next frame.

    Args:
        state: of B clips, or a stack of N states of one clip.
        actions: those that lead into that frame, as in a whole clip's inputs; of a stack, (N, 1, A).
        beyond: False promises that no window is full, which leaves its renewal out of the program.

    Returns:
        The state after the frame, and what the frame is decoded from by branch: tokens (B, S), or mean codes (B, S, D)
        if ``sample.shows_means``.
    """
    decode: Any = partial(_decode_frame, arch, sample, params)
    if state.position.ndim > 0:
        axes = clip_axes(state)
        decode = jax.vmap(decode, (axes, 0), axes)
    if beyond and not arch.departures.rotary:
        full = state.position == arch.frames
        renew: Any = partial(renewed, arch, sample, params)
        state = jax.lax.cond(full.any(), renew, lambda state, full: state, state, full)
    state = decode(state, actions)
    cells = (state.means or state.tokens).items()
    frames_axis = state.position.ndim + 1
    return state, {branch: jnp.take(x, -1, axis=frames_axis) for branch, x in cells}


def _decode_frame(
    arch: Architecture, sample: SampleConfig, params: Params, state: State, actions: Float[Array, "B A"]
) -> State:
    """Decodes the next frame of B clips at one position.

    The first pass covers the last frame, which it commits to the cache, and the next one; later passes cover the next
    one alone. With ``whole_frames`` every pass is final, so that the last frame is in the cache already.
    """
    clips, _, cells = state.tokens["rgb"].shape
    read = mean_codes.read(sample, state.tokens, state.means)
    last = {branch: x[:, -1:] for branch, x in read.items()}
    before_last = {branch: x[:, -2:-1] if x.shape[1] > 1 else x for branch, x in read.items()}
    pair = {branch: jnp.concatenate([x, x], axis=1) for branch, x in last.items()}  # the second is masked, not read
    previous = {branch: jnp.concatenate([before_last[branch], x], axis=1) for branch, x in last.items()}
    mask = jnp.broadcast_to(jnp.array([False, True])[None, :, None], (clips, 2, cells))
    rows = jnp.stack([state.actions[:, -1], actions], axis=1)
    rows = window_actions(arch, rows, state.base, state.position - 1)
    network = partial(
        apply_network,
        arch,
        sample,
        params,
        no_depth=state.no_depth,
        strength=state.guidance,
        keep_trunk=state.features is not None,
    )
    unmask = partial(unmask_step, sample, arch.code_bits, no_depth=state.no_depth, temperature=state.temperature)
    keys = jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, state.frame), sample.steps))(state.key)

    first = 1 - arch.uncommitted  # frame of the first pass
    seen, seen_rows, seen_previous = jax.tree.map(lambda x: x[:, first:], (pair, rows, previous))
    begin = state.position - 1 + first
    logits, cache, trunk = network(seen, mask[:, first:], seen_rows, begin, state.cache, previous=seen_previous)
    features = None
    if state.features is not None:
        assert trunk is not None
        features = jnp.mean(trunk[:, -1], axis=1)
    undecided = {branch: jnp.zeros((clips, cells), jnp.int32) for branch in read}
    entropy = None if state.entropy is None else jnp.zeros((clips, cells))
    frame = Frame(undecided, mask[:, 1], entropy, mean_codes.codes_of(sample, undecided, arch.code_bits))
    frame = unmask(keys[:, 0], 0, frame, {branch: x[:, -1] for branch, x in logits.items()})
    # Without the barrier a second pass's depth branch need not wait for the first pass's RGB, and XLA multiplies the
    # features of both passes by one kernel of depth_to_rgb, which takes a copy and two sums more than two products.
    frame = jax.lax.optimization_barrier(frame)

    def later_pass(number: Array, carry: tuple[Frame, Any]) -> tuple[Frame, Any]:
        frame, _ = carry
        read_now = {branch: x[:, None] for branch, x in mean_codes.read(sample, frame.tokens, frame.means).items()}
        logits, _, trunk = network(read_now, frame.mask[:, None], rows[:, 1:], state.position, cache, previous=last)
        frame = unmask(keys[:, number], number, frame, {branch: x[:, 0] for branch, x in logits.items()})
        return frame, read_state(arch, params, trunk)

    readings = read_state(arch, params, trunk)
    if sample.steps > 1:  # else a loop that never runs would be traced
        frame, readings = jax.lax.fori_loop(1, sample.steps, later_pass, (frame, readings))

    def appended(kept: Array, new: Array) -> Array:
        return jnp.concatenate([kept[:, 1:], new[:, None]], axis=1)

    return replace(
        state,
        tokens=jax.tree.map(appended, state.tokens, frame.tokens),
        means=jax.tree.map(appended, state.means, frame.means),
        actions=appended(state.actions, actions),
        cache=cache,
        position=state.position + 1,
        frame=state.frame + 1,
        entropy=frame.entropy,
        readings=readings,
        features=features,
    )


def read_state(arch: Architecture, params: Params, trunk: Float[Array, "B T S C"] | None) -> Float[Array, "B K"] | None:
    """Returns what the state heads read from the last of these frames; None for a model without them."""
    if not arch.state_heads:
        return None
    assert trunk is not None
    return state_heads.readings(params, trunk[:, -1:])[:, 0]


def renewed(arch: Architecture, sample: SampleConfig, params: Params, state: State, full: Bool[Array, "*N"]) -> State:
    """Returns the state with every full window moved by its stride.

    Args:
        state: of B clips, or a stack of N states of one clip.
        full: whether the window is full; of a stack, each window.
    """
    renew: Any = partial(_renew_window, arch, sample, params)
    if state.position.ndim > 0:
        axes = clip_axes(state)
        renew = jax.vmap(renew, (axes, 0), axes)
    moved: State = renew(state, full)
    return moved


def _renew_window(
    arch: Architecture, sample: SampleConfig, params: Params, state: State, full: Bool[Array, ""]
) -> State:
    """Encodes the frames that stay in a full window from position 0 on."""
    kept = arch.frames - stride(arch, sample)
    newest = slice(-kept, None)
    base = sums_before(state.actions[:, -kept], state.frame - kept, state.resting)
    cache = state.cache
    if encoded := kept - arch.uncommitted:
        read = mean_codes.read(sample, state.tokens, state.means)
        kept_tokens = {branch: x[:, newest][:, :encoded] for branch, x in read.items()}
        rows = window_actions(arch, state.actions[:, newest][:, :encoded], base, 0)
        mask = jnp.zeros(kept_tokens["rgb"].shape[:3], bool)
        _, cache, _ = apply_network(arch, sample, params, kept_tokens, mask, rows, 0, cache, state.no_depth)
    moved = replace(state, base=base, cache=cache, position=jnp.full_like(state.position, kept))
    return where(full, moved, state)


def where(which: Bool[Array, ""], new: State, old: State) -> State:
    """Returns one of two states."""
    chosen: State = jax.tree.map(partial(jnp.where, which), new, old)
    return chosen


def apply_network(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    tokens: dict[str, Cells],
    mask: Bool[Array, "B T S"],
    actions: Float[Array, "B T A"],
    start: Any,
    cache: Any,
    no_depth: Bool[Array, " B"] | None = None,
    previous: dict[str, Cells] | None = None,
    strength: Float[Array, " B"] | None = None,
    keep_trunk: bool = False,
) -> tuple[dict[str, Float[Array, "B T S n V"]], Any, Float[Array, "B T S C"] | None]:
    """Returns the logits of a pass, the cache and the trunk; arguments as for :class:`Transformer`.

    Args:
        params: with stacked blocks, or split by :mod:`rsjax.layers.unstacked_params`.
        cache: from :func:`new_cache` or an earlier call; None: the frames see each other alone.
        strength: of guidance.
        keep_trunk: whether to return the features that RGB's head reads, also if the model has no state heads.
    """
    inputs = (tokens, mask, actions, no_depth, previous)
    (tokens, mask, actions, no_depth, previous), drop = guidance.doubled(sample, inputs, len(mask))
    shape = (*mask.shape[:2], arch.grid, arch.grid)
    grids = {branch: cells.reshape(*shape, *cells.shape[3:]) for branch, cells in tokens.items()}
    whole = params | {"blocks": stack_params(params["blocks"])}
    arguments = (grids, mask.reshape(shape), actions, start, cache, drop, no_depth, previous)
    trunk = None
    if arch.state_heads or keep_trunk:
        logits, cache, trunk = run_with_trunk(arch, whole, *arguments)
        trunk = trunk[: len(trunk) // guidance.copies(sample)]  # of the clips with their actions
    else:
        logits, cache = run_transformer(arch, whole, *arguments)
    return guidance.guided(sample, logits, strength), cache, trunk


def new_cache(arch: Architecture, sample: SampleConfig, clips: int, slots: int) -> StackedCache:
    """Returns an empty cache for :func:`apply_network`."""
    return empty_cache(arch, guidance.copies(sample) * clips, slots, jnp.dtype(sample.cache_dtype))


# Windows


def stride(arch: Architecture, sample: SampleConfig) -> int:
    """Returns the number of frames by which a full window moves (learned positions)."""
    return sample.window_stride or arch.frames // 2


def window_start(arch: Architecture, sample: SampleConfig, frame: Int[Array, ""] | int) -> Int[Array, ""] | int:
    """Returns the first frame of the window that ``frame`` is decoded in: 0 for the first ``arch.frames`` frames."""
    if arch.departures.rotary:
        return 0
    by = stride(arch, sample)
    excess = frame + 1 - arch.frames
    return (excess + by - 1) // by * by * (excess > 0)


def remembered_frames(arch: Architecture, sample: SampleConfig) -> int:
    """Returns K: how many frames stay in a window when it moves, but at least those that the next frame reads."""
    least = 2 if arch.departures.read_previous else 1
    if arch.departures.rotary:
        return least
    return max(arch.frames - stride(arch, sample), least)


def cache_slots(arch: Architecture, past: int) -> int:
    """Returns the number of slots of the temporal cache of a rollout with ``past`` prompt frames.

    In the pass over frames (t-1, t), frame t-1 still attends to t - ``arch.frames``, so a rolling cache has one slot
    more than the window. A longer prompt is encoded in one pass and must fit.
    """
    if not arch.departures.rotary:
        return arch.frames
    return max(arch.frames + 1, past - unread(arch))


def unread(arch: Architecture) -> int:
    """Returns how many of a prompt's frames :func:`start` leaves to the next pass: none that state heads read."""
    if arch.state_heads:
        return 0
    return arch.uncommitted


def resting_actions(arch: Architecture, normalization: Normalization) -> Float[Array, " A"] | None:
    """Returns the actions of a frame of rest if sums begin at the clip's first frame; None: at the window's."""
    if not arch.one_start or not arch.departures.integrate_actions:
        return None
    return jnp.asarray(normalization.resting())


def sums_before(
    actions: Float[Array, "B A"], left: Int[Array, ""] | int, resting: Float[Array, "*B A"] | None
) -> Float[Array, "B A"]:
    """Returns the ``base`` of a window, from which its sums count.

    With ``resting`` the sums go on from the clip's first frame. They are sums of normalised actions, whose mean over
    the training clips is 0, so they drift while the robot rests; frames that left the window take their drift along.

    Args:
        actions: those that lead into the window's first frame.
        left: how many frames of the clip are before it.
        resting: the actions of a frame of rest; None: the sums begin at the window's first frame.
    """
    if resting is None:
        return actions
    return jnp.broadcast_to(left * resting, actions.shape)


def window_actions(
    arch: Architecture, rows: Float[Array, "B T A"], base: Float[Array, "B A"], position: Int[Array, ""] | int
) -> Float[Array, "B T A"]:
    """Returns the actions into the frames from ``position`` on, as in a clip that begins with the window.

    The first frame of a clip has no action, and the sums of ``model.departures.integrate_actions`` start there.

    Args:
        base: those that lead into the window's first frame, or :func:`sums_before` it.
    """
    if arch.departures.integrate_actions:
        is_sum = jnp.arange(rows.shape[-1]) >= rows.shape[-1] // 2
        rows = rows - jnp.where(is_sum, base[:, None], 0.0)
    first = position + jnp.arange(rows.shape[1]) == 0
    return jnp.where(first[None, :, None], 0.0, rows)


# Rollouts


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
    resting: Float[Array, " A"] | None = None,
) -> Decoded:
    """Generates the frames after the prompt.

    One program is compiled for each number of clips, each number of prompt frames and each length, rounded up to a
    multiple of ``arch.frames``.

    Args:
        prompt: the tokens of P frames by branch. If "depth" is missing for a model that uses it, no clip has depth.
        actions: of all T frames, normalised; row t led into frame t, row 0 is not read.
        key: of the random draws; the draws do not depend on actions.
        cached: False recomputes all frames of the window in every pass, for comparison.
        index: each clip's number, which decides its draws together with ``key``; 0, 1, … by default.
        no_depth: True for clips without depth; None: all have depth. Such clips' depth is masked in every frame, as in
            training, and zeros in the result.
        resting: as :func:`resting_actions` returns them.

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
    frames = actions.shape[1]
    _check_lengths(past, frames)
    if clips != len(actions):
        raise ValueError(f"{clips} prompts and {len(actions)} action sequences; encode_prompt shares one among many")
    tokens, no_depth = _prompt_tokens(arch, prompt, no_depth)
    program = _rollout if cached else _recomputed
    keys = _clip_keys(key, index, clips)
    rows = _padded(arch, actions, frames)
    made = program(arch, sample.compiled, params, tokens, no_depth, rows, jnp.asarray(frames), keys, resting)
    return {branch: grid[:, :frames] for branch, grid in made.items()}


def encode_prompt(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    prompt: Tokens,
    actions: Float[Array, "B P A"],
    no_depth: Bool[Array, " B"] | None = None,
    resting: Float[Array, " A"] | None = None,
) -> Prompt:
    """Encodes a prompt for :func:`rollout_from`.

    Args:
        prompt: tokens by branch, as for :func:`rollout`.
        actions: those that led into the prompt's frames, normalised.
        no_depth, resting: as for :func:`rollout`.

    Raises:
        ConfigError: the model does not support these settings.
        ValueError: ``no_depth`` has another number of clips, or the prompt lacks depth tokens of clips with depth.
    """
    arch.check_sampling(sample)
    tokens, no_depth = _prompt_tokens(arch, prompt, no_depth)
    state = compiled_start(arch, sample.compiled, params, tokens, actions, None, no_depth, resting)
    return Prompt(tokens, state, _cache_settings(arch, sample))


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
    for (name, made), (_, wanted) in zip(prompt.settings, _cache_settings(arch, sample), strict=True):
        if made != wanted:
            raise ValueError(f"the prompt was encoded with {name} = {made!r}, the rollout has {wanted!r}; encode anew")
    clips, past = prompt.tokens["rgb"].shape[:2]
    frames = past + actions.shape[1]
    _check_lengths(past, frames)
    if clips not in (1, len(actions)):
        raise ValueError(f"a prompt of {clips} clips and {len(actions)} action sequences; give one prompt, or as many")
    keys = _clip_keys(key, index, len(actions))
    rows = _padded(arch, actions, frames)
    made = _continue(arch, sample.compiled, params, prompt, rows, jnp.asarray(frames), keys)
    return {branch: grid[:, :frames] for branch, grid in made.items()}


def _cache_settings(arch: Architecture, sample: SampleConfig) -> tuple[tuple[str, Any], ...]:
    """Returns the settings that a prompt's cache depends on."""
    return (
        ("guided", sample.guidance != 1),
        ("window_stride", stride(arch, sample)),
        ("cache_dtype", sample.cache_dtype),
    )


def _prompt_tokens(
    arch: Architecture, prompt: Tokens, no_depth: Any
) -> tuple[dict[str, Int[Array, "B P S"]], Array | None]:
    """Checks and returns the prompt's tokens of the model's modalities, and ``no_depth`` if the model needs it."""
    cells = {branch: jnp.asarray(grid, jnp.int32).reshape(*grid.shape[:2], -1) for branch, grid in prompt.items()}
    if arch.depth == "none":
        return {name: cells[name] for name in arch.modalities}, None
    clips = len(cells["rgb"])
    if no_depth is not None and np.shape(no_depth) != (clips,):
        raise ValueError(f"no_depth has shape {np.shape(no_depth)}; the prompt has {clips} clips, each needs one value")
    if "depth" in cells:
        if isinstance(no_depth, np.ndarray) and not no_depth.any():  # the program without it is smaller
            no_depth = None
        return {name: cells[name] for name in arch.modalities}, no_depth
    if no_depth is not None and not np.all(no_depth):
        raise ValueError('no_depth says that clips have depth, but the prompt has no tokens "depth"')
    return cells | {"depth": jnp.zeros_like(cells["rgb"])}, jnp.ones(clips, bool)


def _check_lengths(past: int, frames: int) -> None:
    if not 0 < past < frames:
        raise ValueError(f"{frames} frames with a prompt of {past}; a rollout needs a prompt and a frame to generate")


def _clip_keys(key: Key[Array, ""], index: Int[Array, " B"] | None, clips: int) -> Key[Array, " B"]:
    numbers = jnp.arange(clips) if index is None else jnp.asarray(index)
    return jax.vmap(partial(jax.random.fold_in, key))(numbers)


def _padded(arch: Architecture, actions: Float[Array, "B T A"], frames: int) -> Float[Array, "B T2 A"]:
    """Pads actions as if a clip of ``frames`` frames went on to a multiple of ``arch.frames``."""
    return jnp.pad(actions, ((0, 0), (0, -frames % arch.frames), (0, 0)))


compiled_start = jax.jit(start, static_argnums=(0, 1))


@partial(jax.jit, static_argnums=(0, 1))
def _rollout(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    tokens: dict[str, Int[Array, "B P S"]],
    no_depth: Bool[Array, " B"] | None,
    actions: Float[Array, "B T A"],
    frames: Int[Array, ""],
    keys: Key[Array, " B"],
    resting: Float[Array, " A"] | None,
) -> Decoded:
    past = tokens["rgb"].shape[1]
    state = start(arch, sample, params, tokens, actions[:, :past], keys, no_depth, resting)
    return with_few_launches(arch, partial(_repeat_step, sample, params, tokens, state, actions[:, past:], frames))


@partial(jax.jit, static_argnums=(0, 1))
def _continue(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    prompt: Prompt,
    actions: Float[Array, "N F A"],
    frames: Int[Array, ""],
    keys: Key[Array, " N"],
) -> Decoded:
    """Continues a prompt, which is repeated for all action sequences if it has one clip."""
    clips = len(actions)

    def repeated(x: Array) -> Array:
        return jnp.broadcast_to(x, (clips, *x.shape[1:]))

    def repeated_cache(x: Float[Array, "L c S h N e"]) -> Float[Array, "L cB S h N e"]:
        copies = guidance.copies(sample)
        each = x.reshape(len(x), copies, -1, *x.shape[2:])
        return jnp.broadcast_to(each, (len(x), copies, clips, *x.shape[2:])).reshape(len(x), -1, *x.shape[2:])

    tokens = jax.tree.map(repeated, prompt.tokens)
    state = prompt.state
    state = replace(
        state,
        tokens=jax.tree.map(repeated, state.tokens),
        means=jax.tree.map(repeated, state.means),
        actions=repeated(state.actions),
        base=repeated(state.base),
        cache=jax.tree.map(repeated_cache, state.cache),
        key=keys,
        no_depth=None if state.no_depth is None else repeated(state.no_depth),
        readings=None if state.readings is None else repeated(state.readings),
        resting=None if state.resting is None else repeated(state.resting),
    )
    return with_few_launches(arch, partial(_repeat_step, sample, params, tokens, state, actions, frames))


def _repeat_step(
    sample: SampleConfig,
    params: Params,
    prompt: dict[str, Int[Array, "B P S"]],
    state: State,
    actions: Float[Array, "B F A"],
    frames: Int[Array, ""],
    arch: Architecture,
) -> Decoded:
    """Generates frames P to ``frames`` - 1 by repeated :func:`step`."""
    past = prompt["rgb"].shape[1]
    beyond = past + actions.shape[1] > arch.frames
    params = for_many_passes(arch, params)
    state = replace(state, cache=unstack_params(state.cache, arch.groups, arch.unroll))
    known = mean_codes.codes_of(sample, prompt, arch.code_bits) or prompt
    made = {branch: _with_room(cells, actions.shape[1]) for branch, cells in known.items()}
    made |= _prompt_readings(state, past, actions.shape[1])

    def next_frame(number: Array, carry: tuple[State, dict[str, Array]]) -> tuple[State, dict[str, Array]]:
        state, made = carry
        row = jax.lax.dynamic_index_in_dim(actions, number - past, axis=1, keepdims=False)
        state, frame = step(arch, sample, params, state, row, beyond)
        if state.readings is not None:
            frame["state"] = state.readings
        return state, _put(made, frame, number)

    state, made = jax.lax.fori_loop(past, frames, next_frame, (state, made))
    return _grids(arch, made, state.no_depth)


@partial(jax.jit, static_argnums=(0, 1))
def _recomputed(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    prompt: dict[str, Int[Array, "B P S"]],
    no_depth: Bool[Array, " B"] | None,
    actions: Float[Array, "B T A"],
    frames: Int[Array, ""],
    keys: Key[Array, " B"],
    resting: Float[Array, " A"] | None,
) -> Decoded:
    """Eq. 1 without a cache: every pass covers the whole window. The reference for :func:`step`."""
    past = prompt["rgb"].shape[1]
    total = actions.shape[1]
    length = total
    if not arch.departures.rotary:
        length = arch.frames
    actions = jnp.pad(actions, ((0, 0), (0, length), (0, 0)))
    params = for_many_passes(arch, params)
    tokens = {branch: _with_room(cells, total - past + length) for branch, cells in prompt.items()}
    means = mean_codes.codes_of(sample, tokens, arch.code_bits)
    made: dict[str, Array] = {}
    if arch.state_heads:
        after_prompt = start(arch, sample, params, prompt, actions[:, :past], keys, no_depth, resting)
        made = _prompt_readings(after_prompt, past, total - past + length)

    def next_frame(t: Array, carry: tuple[dict[str, Array], ...]) -> tuple[dict[str, Array], ...]:
        tokens, means, made = carry
        base = window_start(arch, sample, t)
        rows = jax.lax.dynamic_slice_in_dim(actions, base, length, axis=1)
        rows = window_actions(arch, rows, sums_before(rows[:, 0], base, resting), 0)
        step_keys = jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, t), sample.steps))(keys)
        undecided = {branch: cells[:, 0] for branch, cells in tokens.items()}
        masked = jnp.ones(undecided["rgb"].shape, bool)
        frame = Frame(undecided, masked, None, mean_codes.codes_of(sample, undecided, arch.code_bits))

        def one_pass(number: Array, carry: tuple[Frame, dict[str, Array]]) -> tuple[Frame, dict[str, Array]]:
            frame, _ = carry
            read = mean_codes.read(sample, tokens, means)
            clip = _put(read, mean_codes.read(sample, frame.tokens, frame.means), t)
            window = {
                branch: jax.lax.dynamic_slice_in_dim(cells, base, length, axis=1) for branch, cells in clip.items()
            }
            is_t = jnp.arange(length)[None, :, None] == t - base
            mask = is_t & frame.mask[:, None]
            logits, _, trunk = apply_network(arch, sample, params, window, mask, rows, 0, None, no_depth)
            at_t = {branch: x[:, t - base] for branch, x in logits.items()}
            frame = unmask_step(sample, arch.code_bits, step_keys[:, number], number, frame, at_t, no_depth)
            if not arch.state_heads:
                return frame, {}
            assert trunk is not None
            return frame, {"state": state_heads.readings(params, trunk)[:, t - base]}

        unknown = {name: x[:, 0] for name, x in made.items()}
        frame, readings = jax.lax.fori_loop(0, sample.steps, one_pass, (frame, unknown))
        return _put(tokens, frame.tokens, t), _put(means, frame.means, t), _put(made, readings, t)

    tokens, means, made = jax.lax.fori_loop(past, frames, next_frame, (tokens, means, made))
    return _grids(arch, (means or tokens) | made, no_depth)


def with_few_launches(arch: Architecture, run: Callable[[Architecture], Any]) -> Any:
    """Returns ``run(arch)``; if products are bf16, of :func:`written_out` where launches take long."""
    if arch.compute_dtype != "bfloat16":
        return run(arch)
    return where_launches_take_long(partial(run, written_out(arch)), partial(run, arch))


def written_out(arch: Architecture) -> Architecture:
    """Returns the settings of a generating program whose blocks are all written out, not scanned over.

    A scan would copy each block's parameters and cache out of their stacks in every pass. For few clips these kernels
    would take longer, by their launches alone, than all others.
    """
    return replace(arch, unroll=arch.groups, feature_dtype="bfloat16")


def for_many_passes(arch: Architecture, params: Params) -> Params:
    """Returns the parameters as a loop around the network reads them fastest: rounded once, and blocks split."""
    blocks = params["blocks"]
    if arch.compute_dtype == "bfloat16":
        blocks = rounded(blocks, ADDED_IN_BF16 if arch.feature_dtype == "bfloat16" else ())
    return params | {"blocks": unstack_params(blocks, arch.groups, arch.unroll)}


def _prompt_readings(state: State, past: int, frames: int) -> dict[str, Float[Array, "B T K"]]:
    """Returns the readings of a rollout before its first step: NaN before the prompt's last frame."""
    if state.readings is None:
        return {}
    last = state.readings[:, None]
    return {"state": jnp.pad(last, ((0, 0), (past - 1, frames), (0, 0)), constant_values=jnp.nan)}


def _with_room(cells: Array, frames: int) -> Array:
    """Returns cells followed by zeros for this many frames."""
    return jnp.pad(cells, [(0, 0), (0, frames), *[(0, 0)] * (cells.ndim - 2)])


def _put(clips: dict[str, Array], frame: dict[str, Array], t: Array) -> dict[str, Array]:
    """Returns the cells of all frames with this frame's at position t."""
    return {
        branch: jax.lax.dynamic_update_slice_in_dim(cells, frame[branch][:, None], t, axis=1)
        for branch, cells in clips.items()
    }


def _grids(arch: Architecture, cells: dict[str, Array], no_depth: Bool[Array, " B"] | None) -> Decoded:
    """Returns the grids that pictures are decoded from, with zeros as depth of clips that have none, and readings."""
    grids = dict(cells)
    for branch in arch.modalities:
        x = cells[branch]
        grids[branch] = x.reshape(*x.shape[:2], arch.grid, arch.grid, *x.shape[3:])
    if no_depth is not None:
        hidden = no_depth.reshape(-1, *[1] * (grids["depth"].ndim - 1))
        grids["depth"] = jnp.where(hidden, 0, grids["depth"])
    return grids
