"""Continues any clip from any of its frames: implements :class:`rsjax.models.branch_states.Branching` for token models.

A frame has the same bits whichever frames share its pass. On an accelerator, every pass is over the same number of
clips, the lanes, and repeated clips fill empty lanes: with another number, floating-point sums would differ in their
last bit. On a CPU, clips are generated one by one: there, the last bits of a row of a product may also depend on its
place among the rows (seen without AVX-512), and larger passes gain little (``notebooks/cpu-performance.md``).

Axes: N clips, S cells, A action dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int, UInt8

from rsjax.clip import Video
from rsjax.config import SampleConfig, TokenizerConfig, TokenModelConfig
from rsjax.data.normalization import with_sums
from rsjax.devices import on_cpu
from rsjax.models.branch_states import BranchState, Decoding
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures import mean_codes
from rsjax.models.roboscape.departures.keep_still import keep_still
from rsjax.models.roboscape.departures.second_view import views
from rsjax.models.roboscape.sample import State, compiled_start, resting_actions, step, with_few_launches
from rsjax.models.roboscape.transformer import Cache
from rsjax.tokenizers.codec import Codec
from rsjax.tokenizers.magvit2 import for_many_pictures, run_tokenizer
from rsjax.trainable import Params


@dataclass(frozen=True)
class _Memory:
    """The memory from which a clip continues.

    Attributes:
        state: of one clip, without its cache.
        cache: None if the clip has its first frame only, or if its window is full and is encoded again anyway.
        sums: of the clip's scaled actions.
        first: the clip's first frame, recorded and decoded.
    """

    state: State
    cache: Cache | None
    sums: Float[np.ndarray, " A"]
    first: tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W 3"]]


class TokenBranching:
    """Implements :class:`rsjax.models.branch_states.Branching`.

    Args:
        has_depth: whether the clips have depth; otherwise a model that uses depth sees it masked.
        lanes: clips in a pass.
    """

    def __init__(
        self,
        config: TokenModelConfig,
        arch: Architecture,
        codec: Codec,
        params: Params,
        has_depth: bool,
        lanes: int,
    ) -> None:
        self.lanes = lanes
        self._width = program_clips(lanes)
        self._config = config
        self._arch = arch
        self._codec = codec
        self._params = params
        self._decoder = jax.jit(for_many_pictures, static_argnums=0)(codec.config, codec.params)
        self._has_depth = arch.depth != "none" and has_depth and codec.normalization.depth_range is not None
        # First states are on the parameters' devices, as are those that passes return, so that one program takes both.
        where = getattr(jax.tree.leaves(params)[0], "sharding", None) or jax.local_devices()[0]
        self._place = partial(jax.device_put, device=where)

    def begin(self, first: Video) -> BranchState:
        video = views(first, self._has_depth, self._arch.second_view)
        grids = self._codec.encode(video)
        cells = {branch: jnp.asarray(grid.reshape(1, 1, -1), jnp.int32) for branch, grid in grids.items()}
        if self._arch.depth != "none":
            cells.setdefault("depth", jnp.zeros_like(cells["rgb"]))
        state = replace(self._start(self._sample(Decoding(steps=1)), cells), cache={})
        sums = np.zeros(len(self._codec.normalization.action_mean))
        tokens = {branch: grid.reshape(-1) for branch, grid in grids.items()}
        decoded = self._codec.decode_rgb(grids["rgb"])[0, 0]
        memory = _Memory(state, None, sums, (first.rgb[0, 0], decoded))
        return BranchState(self._shown(memory, decoded), tokens, None, memory, state=_readings(state))

    def advance(
        self, states: Sequence[BranchState], actions: Float[np.ndarray, "N A"], decodings: Sequence[Decoding]
    ) -> list[BranchState]:
        made = []
        for first in range(0, len(states), self._width):
            part = slice(first, first + self._width)
            made += self._advance(states[part], actions[part], decodings[part])
        return made

    def _advance(
        self, states: Sequence[BranchState], actions: Float[np.ndarray, "N A"], decodings: Sequence[Decoding]
    ) -> list[BranchState]:
        """Advances clips in one run of the program; the first clip fills lanes that are left over."""
        count = len(states)
        lanes = [*range(count), *[0] * (self._width - count)]
        memories: list[_Memory] = [states[lane].memory for lane in lanes]
        chosen = [decodings[lane] for lane in lanes]
        sample = self._sample(chosen[0])
        scaled = self._codec.normalization.scaled(actions[lanes])
        sums = np.stack([memory.sums for memory in memories]) + scaled
        rows = with_sums(scaled, sums if self._config.departures.integrate_actions else None)
        caches = []
        for lane, memory in enumerate(memories):
            cache = memory.cache
            if cache is None or lane >= count:  # a pass uses up its caches, so that none can be in two lanes
                cache = self._start(sample, {name: cells[:, -1:] for name, cells in memory.state.tokens.items()}).cache
            caches.append(cache)
        clips = []
        for state in (memory.state for memory in memories):
            means = mean_codes.codes_of(sample, state.tokens, self._arch.code_bits)
            if means and state.means:  # frames that have no mean codes get their tokens' codes
                means = state.means
            clips.append(replace(state, means=means))
        new, new_caches, rgb = _advance(
            self._arch,
            sample,
            self._codec.config,
            self._params,
            self._decoder,
            tuple(caches),
            tuple(clips),
            rows,
            np.array([(each.seed, each.draw) for each in chosen], np.uint32),
            np.array([each.temperature for each in chosen], np.float32),
            np.array([each.guidance for each in chosen], np.float32),
        )
        pictures = np.asarray(rgb)
        return [
            self._branch_state(_Memory(new[i], new_caches[i], sums[i], memories[i].first), pictures[i])
            for i in range(count)
        ]

    def lightened(self, state: BranchState) -> BranchState:
        """Leaves out the cache if the window is full, as it is then encoded again; otherwise, the whole memory."""
        memory = state.memory
        if memory is None or memory.cache is None:
            return state
        if self._arch.departures.rotary or int(memory.state.position) < self._arch.frames:
            return replace(state, memory=None)
        return replace(state, memory=replace(memory, cache=None))

    def depth(self, state: BranchState) -> Float32[np.ndarray, "H W"] | None:
        cells = (state.means or state.tokens).get("depth")
        if cells is None:
            return None
        return self._codec.decode_depth(cells.reshape(1, self._arch.grid, self._arch.grid, *cells.shape[1:]))[0]

    def _sample(self, decoding: Decoding) -> SampleConfig:
        """Returns the settings of a decoding's program, which takes temperature and guidance as arguments.

        A model that can be guided always is, so that its cache always has the same shape.
        """
        return replace(
            self._config.sample,
            seed=0,
            temperature=float(decoding.temperature > 0),
            guidance=2.0 if self._arch.departures.action_dropout else 1.0,
            steps=decoding.steps,
            top_k=decoding.top_k,
        )

    def _start(self, sample: SampleConfig, tokens: dict[str, Int[Array, "1 1 S"]]) -> State:
        """Returns the state of one clip after its first frame."""
        hidden = jnp.ones(1, bool) if self._arch.depth != "none" and not self._has_depth else None
        actions = jnp.zeros((1, 1, self._arch.action_inputs))
        resting = resting_actions(self._arch, self._codec.normalization)
        state: State = self._place(
            compiled_start(self._arch, sample, self._params, tokens, actions, None, hidden, resting)
        )
        return state

    def _branch_state(self, memory: _Memory, rgb: UInt8[np.ndarray, "H W 3"]) -> BranchState:
        state = memory.state
        branches = [name for name in self._arch.modalities if name != "depth" or self._has_depth]
        tokens = {branch: np.asarray(state.tokens[branch][0, -1]) for branch in branches}
        means = {branch: np.asarray(cells[0, -1]) for branch, cells in state.means.items() if branch in branches}
        assert state.entropy is not None
        size = sum(leaf.nbytes for leaf in jax.tree.leaves(memory.cache))
        without = replace(memory, state=replace(state, entropy=None, features=None))
        features = np.asarray(state.features)[0]
        shown = self._shown(memory, rgb)
        return BranchState(
            shown, tokens, np.asarray(state.entropy[0]), without, size, means, features, _readings(state)
        )

    def _shown(self, memory: _Memory, decoded: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
        """Returns the frame to show."""
        still = self._config.sample.keep_still
        if still is None:
            return decoded
        return keep_still(still, self._codec.config.downsampling, decoded[None], *memory.first)[0]


def _readings(state: State) -> Float[np.ndarray, " K"] | None:
    """Returns what the state heads read from the last frame of one clip; None without heads."""
    if state.readings is None:
        return None
    return np.asarray(state.readings)[0]


def program_clips(lanes: int) -> int:
    """Returns how many clips one run of the program generates."""
    if on_cpu():
        return 1
    return lanes


@partial(jax.jit, static_argnums=(0, 1, 2), donate_argnums=(5,))
def _advance(
    arch: Architecture,
    sample: SampleConfig,
    tokenizer: TokenizerConfig,
    params: Params,
    tokenizer_params: Params,
    caches: tuple[Cache, ...],
    states: tuple[State, ...],
    actions: Float[Array, "N A"],
    seeds: Int[Array, "N 2"],
    temperature: Float[Array, " N"],
    guidance: Float[Array, " N"],
) -> tuple[tuple[State, ...], tuple[Cache, ...], UInt8[Array, "N H W 3"]]:
    """Returns the states and caches after the next frame, and the frames."""
    keys = jax.vmap(lambda row: jax.random.fold_in(jax.random.key(row[0]), row[1]))(seeds)
    stacked: State = jax.tree.map(lambda *clips: jnp.stack(clips), *states)
    stacked = replace(
        stacked,
        cache=jax.tree.map(lambda *clips: jnp.stack(clips, axis=1), *caches),
        key=keys[:, None],
        temperature=temperature[:, None],
        guidance=guidance[:, None],
        entropy=jnp.zeros((len(states), 1, arch.grid**2)),
        features=jnp.zeros((len(states), 1, arch.width)),
    )
    stacked, frame = with_few_launches(arch, lambda arch: step(arch, sample, params, stacked, actions[:, None]))
    grid = frame["rgb"].reshape(len(states), arch.grid, arch.grid, *frame["rgb"].shape[3:])
    pixels: Any = run_tokenizer(tokenizer, tokenizer_params, grid, "decode")
    kept = replace(stacked, cache={}, key=None, temperature=None, guidance=None)
    numbers = range(len(states))
    parts = tuple(jax.tree.map(lambda x, i=i: x[i], kept) for i in numbers)
    new_caches = tuple(jax.tree.map(lambda x, i=i: x[:, i], stacked.cache) for i in numbers)
    return parts, new_caches, jnp.round(pixels).astype(jnp.uint8)
