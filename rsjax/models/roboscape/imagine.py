"""Generates frame by frame from pixels to pixels: one compiled program decodes the tokens, and then their pictures.

On a CPU the program takes ``GROUP`` clips, and groups run at the same time. The features of so few clips stay in the
processor's cache, and one program serves any number of clips. Windows that are full are encoded again clip by clip.

Axes: B clips, N of them, G clips of a group, S cells, A action dimensions.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from rsjax.clip import Video
from rsjax.config import SampleConfig, TokenizerConfig, TokenModelConfig
from rsjax.data.depth_color import color_to_depth
from rsjax.data.normalization import Normalization, with_sums
from rsjax.devices import on_cpu
from rsjax.layers.unstacked_params import unstack_params
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures.keep_still import keep_still
from rsjax.models.roboscape.departures.second_view import views
from rsjax.models.roboscape.sample import (
    CLIPS,
    State,
    clip_axes,
    for_many_passes,
    renewed,
    resting_actions,
    start,
    step,
    stride,
    where,
    window_start,
    with_few_launches,
)
from rsjax.tokenizers.codec import Codec, each_pass
from rsjax.tokenizers.magvit2 import for_many_pictures, run_tokenizer
from rsjax.trainable import Params

GROUP = 8


class TokenImagination:
    """Implements :class:`rsjax.models.base.Imagination`. Frames have depth if the model and its training clips have it.

    Args:
        clips: their number.
        depth: False: if the network predicts depth, since later frames depend on it, it is not decoded to metres.

    Raises:
        ConfigError: the model does not support these sampling settings.
    """

    def __init__(
        self,
        config: TokenModelConfig,
        arch: Architecture,
        codec: Codec,
        params: Params,
        clips: int,
        depth: bool = True,
    ) -> None:
        arch.check_sampling(config.sample)
        self._config = config
        self._arch = arch
        self._codec = codec
        self._params = jax.jit(for_many_passes, static_argnums=0)(arch, params)
        self._decoder = jax.jit(for_many_pictures, static_argnums=0)(codec.config, codec.params)
        self._has_depth = arch.depth != "none" and codec.normalization.depth_range is not None
        self._shows_depth = self._has_depth and depth
        self._size = clips
        self._renewed = clips  # clips whose windows one program moves
        if on_cpu():
            self._size = min(clips, GROUP)
            self._renewed = 1
        self._states: list[State | None] = [None] * -(-clips // self._size)
        self._positions = np.zeros(clips, int)  # the next frame's in each window
        self._sums = np.zeros((clips, len(codec.normalization.action_mean)))
        side = arch.grid * codec.config.downsampling
        self._first = np.zeros((clips, side, side, 3), np.uint8)  # recorded
        self._decoded = np.zeros_like(self._first)

    def restart(self, which: Bool[np.ndarray, " B"], first: Video, index: Int[np.ndarray, " N"]) -> Video:
        video = views(first, self._has_depth, self._arch.second_view)
        grids = self._codec.encode(video)
        count = len(which)
        rows = np.zeros(count, int)  # of all clips; those that go on take any
        rows[which] = np.arange(len(first))
        tokens = {name: grid.reshape(len(first), 1, -1) for name, grid in grids.items()}
        if self._arch.depth != "none":
            tokens.setdefault("depth", np.zeros_like(tokens["rgb"]))
        draws = np.asarray(index, np.int32)
        hidden = None
        if self._arch.depth != "none" and not self._has_depth:
            hidden = np.ones(self._size, bool)
        for number, old in enumerate(self._states):
            lanes = self._lanes(number, count)
            if old is not None and not which[lanes].any():
                continue
            these = rows[lanes]
            cells = {name: grid[these] for name, grid in tokens.items()}
            sample = self._config.sample
            resting = resting_actions(self._arch, self._codec.normalization)
            fresh = _start(self._arch, sample, self._params, cells, draws[these], hidden, resting)
            if old is None:
                self._states[number] = fresh
            else:
                self._states[number] = _restarted(which[lanes], fresh, old)
        self._positions[which] = 1 - int(window_start(self._arch, self._config.sample, 1))
        self._sums[which] = 0
        video = self._codec.decode(grids, np.full(len(first), self._shows_depth))
        self._first[which] = first.rgb[:, 0]
        self._decoded[which] = video.rgb[:, 0]
        return replace(video, rgb=self._shown(video.rgb, which), state=self._readings(which))

    def step(self, actions: Float[np.ndarray, "B A"]) -> Video:
        scaled = self._codec.normalization.scaled(actions)
        self._sums += scaled
        rows = with_sums(scaled, self._sums if self._config.departures.integrate_actions else None)
        count = len(rows)
        full = np.zeros(count, bool)
        if not self._arch.departures.rotary:
            full = self._positions == self._arch.frames
            self._positions[full] -= stride(self._arch, self._config.sample)
        self._positions += 1

        def run(number: int) -> tuple[np.ndarray, np.ndarray | None]:
            state = self._states[number]
            assert state is not None, "restart the clips first"
            lanes = self._lanes(number, count)
            for first in range(0, self._size, self._renewed):
                these = full[lanes[first : first + self._renewed]]
                if these.any():
                    state = _with_renewed(self._arch, self._config.sample, self._params, state, first, these)
            self._states[number], rgb, depth = _step(
                self._arch,
                self._config.sample,
                self._codec.config,
                self._codec.normalization if self._shows_depth else None,
                self._params,
                self._decoder,
                state,
                rows[lanes],
            )
            return np.asarray(rgb), None if depth is None else np.asarray(depth)

        made = each_pass(run, range(len(self._states)))
        rgb = np.concatenate([frames for frames, _ in made])[:count, None]
        depths = [metres for _, metres in made if metres is not None]
        depth = None
        if depths:
            depth = np.concatenate(depths)[:count, None]
        return Video(self._shown(rgb), depth, state=self._readings(slice(None)))

    def _shown(
        self, decoded: UInt8[np.ndarray, "N 1 H W 3"], which: Any = slice(None)
    ) -> UInt8[np.ndarray, "N 1 H W 3"]:
        """Returns the frames to show of these clips."""
        still = self._config.sample.keep_still
        if still is None:
            return decoded
        token = self._codec.config.downsampling
        return keep_still(still, token, decoded, self._first[which], self._decoded[which])

    def _lanes(self, number: int, count: int) -> Int[np.ndarray, " G"]:
        """Returns the clips of a group; the last clip fills what is left over."""
        return np.minimum(np.arange(number * self._size, (number + 1) * self._size), count - 1)

    def _readings(self, which: Any) -> Float[np.ndarray, "N 1 3"] | None:
        """Returns what the state heads read from the last frames of clips; None without heads."""
        read = [states.readings for states in self._states if states is not None and states.readings is not None]
        if not read:
            return None
        return np.concatenate([np.asarray(each) for each in read])[: len(self._sums)][which]


@partial(jax.jit, static_argnums=(0, 1))
def _start(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    tokens: dict[str, Int[Array, "B 1 S"]],
    index: Int[Array, " B"],
    no_depth: Bool[Array, " B"] | None,
    resting: Float[Array, " A"] | None,
) -> State:
    """Returns a stack of states, one for each clip, after first frames; ``index`` decides each clip's draws."""
    actions = jnp.zeros((1, 1, arch.action_inputs))
    keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(sample.seed)))(index)

    def start_clip(tokens: dict[str, Array], key: Array, no_depth: Array | None) -> State:
        cells = {name: x[None] for name, x in tokens.items()}
        hidden = None if no_depth is None else no_depth[None]
        return start(arch, sample, params, cells, actions, key[None], hidden, resting)

    stacked: State = jax.vmap(start_clip, out_axes=CLIPS)(tokens, keys, no_depth)
    return replace(stacked, cache=unstack_params(stacked.cache, arch.groups, arch.unroll))


@jax.jit
def _restarted(which: Bool[Array, " B"], fresh: State, old: State) -> State:
    """Returns the fresh states of the clips ``which``, and the old ones of the others."""
    axes = clip_axes(old)
    stacked: State = jax.vmap(where, (0, axes, axes), axes)(which, fresh, old)
    return stacked


@partial(jax.jit, static_argnums=(0, 1), donate_argnums=3)  # a program of its own, since few steps need it
def _with_renewed(
    arch: Architecture, sample: SampleConfig, params: Params, state: State, first: int, full: Bool[Array, " N"]
) -> State:
    """Returns the state of B clips with the full windows among N of them, from ``first`` on, moved by their stride."""

    def cut(axis: int, part: Any) -> Any:
        return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, first, len(full), axis), part)

    def put(axis: int, part: Any, new: Any) -> Any:
        return jax.tree.map(lambda x, y: jax.lax.dynamic_update_slice_in_dim(x, y, first, axis), part, new)

    axes = clip_axes(state)
    moved = renewed(arch, sample, params, jax.tree.map(cut, axes, state), full)
    whole: State = jax.tree.map(put, axes, state, moved)
    return whole


@partial(jax.jit, static_argnums=(0, 1, 2, 3), donate_argnums=(6,))
def _step(
    arch: Architecture,
    sample: SampleConfig,
    tokenizer: TokenizerConfig,
    normalization: Normalization | None,
    params: Params,
    tokenizer_params: Params,
    state: State,
    actions: Float[Array, "B A"],
) -> tuple[State, Array, Array | None]:
    """Returns the state after the next frame, and the frame: uint8, and metres if ``normalization`` is given."""
    state, frame = with_few_launches(
        arch, lambda arch: step(arch, sample, params, state, actions[:, None], beyond=False)
    )

    near_far = None
    cells = [frame["rgb"]]
    if normalization is not None and normalization.depth_range is not None:
        near_far = normalization.depth_range
        cells.append(frame["depth"])
    # RGB and depth in one pass, so that the decoder is compiled once.
    grids = jnp.concatenate([x.reshape(len(actions), arch.grid, arch.grid, *x.shape[3:]) for x in cells])
    pictures: Array = run_tokenizer(tokenizer, tokenizer_params, grids, "decode")
    rgb = jnp.round(pictures[: len(actions)]).astype(jnp.uint8)
    if near_far is None:
        return state, rgb, None
    return state, rgb, color_to_depth(pictures[len(actions) :], *near_far, tokenizer.depth_scale)
