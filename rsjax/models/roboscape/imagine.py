"""Generates frame by frame from pixels to pixels: one compiled program decodes the tokens, and then their pictures.

Axes: B clips, N of them, S cells, A action dimensions.
"""

from dataclasses import replace
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from rsjax.clip import Video
from rsjax.config import SampleConfig, TokenizerConfig, TokenModelConfig
from rsjax.data.depth_color import color_to_depth
from rsjax.data.normalization import Normalization, with_sums
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.sample import CLIPS, State, start, step, where, with_few_launches
from rsjax.tokenizers.codec import Codec
from rsjax.tokenizers.magvit2 import run_tokenizer
from rsjax.trainable import Params


class TokenImagination:
    """Implements :class:`rsjax.models.base.Imagination`. Frames have depth if the model and its training clips have it.

    Raises:
        ConfigError: the model does not support these sampling settings.
    """

    def __init__(self, config: TokenModelConfig, arch: Architecture, codec: Codec, params: Params, clips: int) -> None:
        arch.check_sampling(config.sample)
        self._config = config
        self._arch = arch
        self._codec = codec
        self._params = params
        self._has_depth = arch.depth != "none" and codec.normalization.depth_range is not None
        self._state: State | None = None
        self._sums = np.zeros((clips, len(codec.normalization.action_mean)))

    def restart(self, which: Bool[np.ndarray, " B"], first: Video, index: Int[np.ndarray, " N"]) -> Video:
        video = first if self._has_depth else Video(first.rgb)
        grids = self._codec.encode(video)
        rows = np.zeros(len(which), int)  # of all clips; those that go on take any
        rows[which] = np.arange(len(first))
        tokens = {name: jnp.asarray(grid.reshape(len(first), 1, -1)[rows]) for name, grid in grids.items()}
        if self._arch.depth != "none":
            tokens.setdefault("depth", jnp.zeros_like(tokens["rgb"]))
        keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(self._config.sample.seed)))(jnp.asarray(index)[rows])
        hidden = None
        if self._arch.depth != "none" and not self._has_depth:
            hidden = jnp.ones(len(which), bool)
        fresh = _start(self._arch, self._config.sample, self._params, tokens, keys, hidden)
        if self._state is None:
            self._state = fresh
        else:
            self._state = _restarted(jnp.asarray(which), fresh, self._state)
        self._sums[which] = 0
        video = self._codec.decode(grids, np.full(len(first), self._has_depth))
        return replace(video, state=_readings(fresh, which))

    def step(self, actions: Float[np.ndarray, "B A"]) -> Video:
        assert self._state is not None, "restart the clips first"
        scaled = self._codec.normalization.scaled(actions)
        self._sums += scaled
        rows = with_sums(scaled, self._sums if self._config.departures.integrate_actions else None)
        self._state, rgb, depth = _step(
            self._arch,
            self._config.sample,
            self._codec.config,
            self._codec.normalization if self._has_depth else None,
            self._params,
            self._codec.params,
            self._state,
            rows,
        )
        frames = None if depth is None else np.asarray(depth)[:, None]
        return Video(np.asarray(rgb)[:, None], frames, state=_readings(self._state))


def _readings(states: State, which: Any = slice(None)) -> Float[np.ndarray, "N 1 3"] | None:
    """Returns what the state heads read from the last frames of a stack of clips; None without heads."""
    if states.readings is None:
        return None
    return np.asarray(states.readings)[which]


@partial(jax.jit, static_argnums=(0, 1))
def _start(
    arch: Architecture,
    sample: SampleConfig,
    params: Params,
    tokens: dict[str, Int[Array, "B 1 S"]],
    keys: Key[Array, " B"],
    no_depth: Bool[Array, " B"] | None,
) -> State:
    """Returns a stack of states, one for each clip, after first frames."""
    actions = jnp.zeros((1, 1, arch.action_inputs))

    def start_clip(tokens: dict[str, Array], key: Array, no_depth: Array | None) -> State:
        cells = {name: x[None] for name, x in tokens.items()}
        hidden = None if no_depth is None else no_depth[None]
        return start(arch, sample, params, cells, actions, key[None], hidden)

    stacked: State = jax.vmap(start_clip, out_axes=CLIPS)(tokens, keys, no_depth)
    return stacked


@jax.jit
def _restarted(which: Bool[Array, " B"], fresh: State, old: State) -> State:
    """Returns the fresh states of the clips ``which``, and the old ones of the others."""
    stacked: State = jax.vmap(where, (0, CLIPS, CLIPS), CLIPS)(which, fresh, old)
    return stacked


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
    state, frame = with_few_launches(arch, lambda arch: step(arch, sample, params, state, actions[:, None]))

    def pixels(branch: str) -> Array:
        grid = frame[branch].reshape(len(actions), arch.grid, arch.grid, *frame[branch].shape[3:])
        return cast(Array, run_tokenizer(tokenizer, tokenizer_params, grid, "decode"))

    rgb = jnp.round(pixels("rgb")).astype(jnp.uint8)
    if normalization is None or normalization.depth_range is None:
        return state, rgb, None
    return state, rgb, color_to_depth(pixels("depth"), *normalization.depth_range, tokenizer.depth_scale)
