"""Generates frame by frame while the actions come in, for many clips that began at different times.

The frames are those of :func:`rsjax.models.roboscape.rollout.rollout` with its cache. A clip may have any length, as
only one window of its tokens is kept. Clips are at different positions, so each clip's window moves at its own time; a
step in which no window moves takes no extra time.

Axes: B clips, K frames kept, S cells, D code bits, A numbers per frame that the action encoder reads.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float, Int, Key

from rsjax.clip import Array
from rsjax.config import SampleConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.decode import Decoder, no_means, step_keys
from rsjax.models.roboscape.guidance import apply_guided, guided_cache
from rsjax.models.roboscape.transformer import Cache
from rsjax.models.roboscape.window import cache_slots, stride
from rsjax.tokenizers import lfq
from rsjax.trainable import Params


class Network(NamedTuple):
    """The settings of a step; hashable, so that a program is compiled once for them."""

    arch: Architecture
    sample: SampleConfig
    has_depth: bool  # False: no clip has depth, and a depth branch sees it masked
    entropy: bool = False  # whether a state has the entropy of its last frame's tokens


class Dials(NamedTuple):
    """Settings of each clip that replace those of ``Network.sample``, so that new values need no new program.

    They cannot switch on what the program leaves out: random draws if ``Network.sample`` has temperature 0, and
    guidance if it has guidance 1.
    """

    temperature: Float[Array, " B"]
    guidance: Float[Array, " B"]


@struct.dataclass
class State:
    """B clips between two frames.

    Attributes:
        tokens: of the last K frames by branch.
        actions: those that lead into these frames, as in a whole clip's inputs (sums since its first frame).
        base: the row of ``actions`` of the window's first frame.
        cache: of the window's frames except the last ``Architecture.uncommitted``. A clip's first frame is missing
            until the next step. Clips are axis 1.
        position: the next frame's position in its window.
        frame: the next frame's number in its clip.
        key: decides each clip's draws.
        entropy: of the last frame's RGB tokens in nats; None unless ``Network.entropy``.
        means: mean codes of the last K frames by branch; empty unless ``sample.shows_means``.
    """

    tokens: dict[str, Int[Array, "B K S"]]
    actions: Float[Array, "B K A"]
    base: Float[Array, "B A"]
    cache: Cache
    position: Int[Array, " B"]
    frame: Int[Array, " B"]
    key: Key[Array, " B"]
    entropy: Float[Array, "B S"] | None = None
    means: dict[str, Float[Array, "B K S D"]] = struct.field(default_factory=dict)


AXES = State(tokens=0, actions=0, base=0, cache=1, position=0, frame=0, key=0, entropy=0, means=0)  # type: ignore[arg-type]  # of clips


def remembered_frames(net: Network) -> int:
    """Returns K: how many frames stay in a window when it moves, but at least 2 if the model reads previous frames."""
    return max(kept_frames(net), 2 if net.arch.departures.read_previous else 1)


def kept_frames(net: Network) -> int:
    """Returns how many frames stay in a window when it moves: 1, the last frame, for a rolling window."""
    return 1 if net.arch.departures.rotary else net.arch.frames - stride(net.arch, net.sample)


def begin(net: Network, clips: int) -> State:
    """Returns the state of clips before their first :func:`restart`."""
    arch, kept = net.arch, remembered_frames(net)
    cache = guided_cache(arch, net.sample, clips, cache_slots(arch, 1))
    copies = jax.tree.map(lambda x: x.reshape(len(x), clips, -1, *x.shape[2:]), cache)
    numbers = jnp.ones(clips, jnp.int32)
    return State(
        tokens={name: jnp.zeros((clips, kept, arch.grid**2), jnp.int32) for name in arch.branches},
        actions=jnp.zeros((clips, kept, arch.action_inputs)),
        base=jnp.zeros((clips, arch.action_inputs)),
        cache=copies,
        position=numbers,
        frame=numbers,
        key=jax.random.split(jax.random.key(0), clips),
        entropy=jnp.zeros((clips, arch.grid**2)) if net.entropy else None,
        means={name: jnp.stack([codes] * kept, axis=1) for name, codes in no_means(arch, net.sample, clips).items()},
    )


def restart(
    state: State, which: Bool[Array, " B"], first: dict[str, Int[Array, "B S"]], key: Key[Array, " B"]
) -> State:
    """Returns the state with some clips restarted.

    Args:
        which: True for the clips to restart.
        first: tokens of all clips' first frames; those of other clips have no effect.
        key: keys of all clips; those of other clips have no effect.
    """

    def pick(new: Any, old: Any) -> Any:
        return jnp.where(which.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    tokens = {name: grid.at[:, -1].set(pick(first[name], grid[:, -1])) for name, grid in state.tokens.items()}
    means = {
        name: grid.at[:, -1].set(pick(lfq.tokens_to_codes(first[name], grid.shape[-1]), grid[:, -1]))
        for name, grid in state.means.items()
    }
    # The cache stays: its contents are at positions that the clip has not reached yet, so they are not read.
    return replace(
        state,
        tokens=tokens,
        means=means,
        actions=pick(0.0, state.actions),
        base=pick(0.0, state.base),
        position=pick(1, state.position),
        frame=pick(1, state.frame),
        key=pick(key, state.key),
    )


def advance(
    net: Network, params: Params, state: State, actions: Float[Array, "B A"], dials: Dials | None = None
) -> State:
    """Decodes the next frame of every clip; its tokens are ``state.tokens[name][:, -1]`` of the returned state.

    Args:
        actions: the row that leads into that frame, as in a whole clip's inputs.
        dials: each clip's settings; None: those of the network.
    """
    if not net.arch.departures.rotary:
        state = _begin_windows(net, params, kept_frames(net), state, state.position == net.arch.frames)
    if not net.arch.uncommitted:
        state = _begin_windows(net, params, 1, state, state.position == 1)
    return jax.vmap(partial(_decode, net, params), in_axes=(AXES, 0, 0), out_axes=AXES)(state, actions, dials)


def _decoder(net: Network, params: Params, dials: Dials | None = None) -> Decoder:
    """Returns a decoder of one clip."""
    hidden = jnp.ones(1, bool) if net.arch.use_depth and not net.has_depth else None
    unread: Any = None  # decode_pair takes one frame's actions and keys as arguments
    guided, drawn = net.sample.guidance != 1, net.sample.temperature != 0
    strength = dials.guidance[None] if dials is not None and guided else None
    temperature = dials.temperature[None] if dials is not None and drawn else None
    apply = partial(apply_guided, net.arch, net.sample, params, no_depth=hidden, strength=strength)
    return Decoder(net.arch, net.sample, apply, unread, unread, hidden, temperature, net.entropy)


def _decode(net: Network, params: Params, state: State, actions: Float[Array, " A"], dials: Dials | None) -> State:
    """Decodes one clip's next frame; without the axis over clips."""
    read = _read(net, state)
    pair = {name: jnp.stack([grid[-1], grid[-1]])[None] for name, grid in read.items()}
    rows = _window_rows(net.arch, jnp.stack([state.actions[-1], actions]), state.base, state.position - 1)[None]
    keys = step_keys(net.sample, state.key, state.frame)[None]
    before = {name: grid[-2:-1] if len(grid) > 1 else grid for name, grid in read.items()}
    frame, cache = _decoder(net, params, dials).decode_pair(pair, before, rows, state.position, keys, state.cache)
    return replace(
        state,
        tokens={name: jnp.append(grid[1:], frame.tokens[name], axis=0) for name, grid in state.tokens.items()},
        actions=jnp.append(state.actions[1:], actions[None], axis=0),
        cache=cache,
        position=state.position + 1,
        frame=state.frame + 1,
        entropy=None if frame.entropy is None else frame.entropy[0],
        means={name: jnp.append(grid[1:], frame.means[name], axis=0) for name, grid in state.means.items()},
    )


def _read(net: Network, state: State) -> dict[str, Array]:
    """Returns the tokens or mean codes of the last K frames, whichever later frames read."""
    return state.means if net.sample.reads_means else state.tokens


def last_frame(net: Network, state: State, name: str) -> Int[Array, "B H W"] | Float[Array, "B H W D"]:
    """Returns the mean codes that a branch's last frame is decoded from; its tokens if there are no mean codes."""
    made = (state.means or state.tokens)[name][:, -1]
    return made.reshape(-1, net.arch.grid, net.arch.grid, *made.shape[2:])


def _begin_windows(net: Network, params: Params, kept: int, state: State, which: Bool[Array, " B"]) -> State:
    """Begins new windows for the clips ``which``: encodes their last ``kept`` frames into the cache again."""
    begun = jax.vmap(partial(_begin_window, net, params, kept), in_axes=(AXES, 0), out_axes=AXES)
    return jax.lax.cond(which.any(), begun, lambda state, which: state, state, which)


def _begin_window(net: Network, params: Params, kept: int, state: State, this: Bool[Array, ""]) -> State:
    """Begins a new window for one clip, if ``this`` is True."""
    base, cache = state.actions[-kept], state.cache
    if encoded := kept - net.arch.uncommitted:
        frames = slice(-kept, encoded - kept or None)
        tokens = {name: grid[None, frames] for name, grid in _read(net, state).items()}
        rows = _window_rows(net.arch, state.actions[frames], base, 0)[None]
        mask = jnp.zeros((1, encoded, net.arch.grid**2), bool)
        _, cache = _decoder(net, params).apply(tokens, mask, rows, 0, cache)
    choose = partial(jax.tree.map, lambda new, old: jnp.where(this, new, old))
    return replace(
        state,
        base=choose(base, state.base),
        cache=choose(cache, state.cache),
        position=choose(jnp.full_like(state.position, kept), state.position),
    )


def _window_rows(
    arch: Architecture, rows: Float[Array, "T A"], base: Float[Array, " A"], start: Int[Array, ""] | int
) -> Float[Array, "T A"]:
    """Returns the actions of frames from position ``start`` on, as in a clip that begins with the window."""
    if arch.departures.integrate_actions:
        rows = rows - jnp.where(jnp.arange(rows.shape[-1]) >= rows.shape[-1] // 2, base, 0.0)
    first = (start + jnp.arange(len(rows)) == 0)[:, None]
    return jnp.where(first, 0.0, rows) if not arch.departures.rotary else rows
