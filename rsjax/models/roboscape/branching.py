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
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int, UInt8

from rsjax.clip import Video
from rsjax.config import TokenizerConfig, TokenModelConfig
from rsjax.data.normalization import with_sums
from rsjax.models.branch_states import Decoding, Moment
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.stepping import Dials, Network, State, advance, begin, last_frame, restart
from rsjax.models.roboscape.transformer import Cache
from rsjax.tokenizers import lfq
from rsjax.tokenizers.codec import Codec
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.trainable import Params


@dataclass(frozen=True)
class _Memory:
    """The state from which a moment's clip continues.

    Attributes:
        state: of one clip, without its cache.
        cache: None stands for an empty one.
        sums: of the clip's scaled actions.
    """

    state: State
    cache: Cache | None
    sums: Float[np.ndarray, " A"]


class TokenBranching:
    """Implements :class:`rsjax.models.branch_states.Branching`.

    Args:
        has_depth: whether the clips have depth; otherwise a depth branch sees it masked.
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
        self._config, self._arch, self._codec, self._params = config, arch, codec, params
        self._has_depth = arch.use_depth and has_depth and codec.normalization.depth_range is not None
        # The state that clips begin with. It is on the parameters' devices, as are the states that passes return, so
        # that one program takes both.
        where = getattr(jax.tree.leaves(params)[0], "sharding", None) or jax.local_devices()[0]
        self._place = partial(jax.device_put, device=where)
        self._empty = self._place(begin(self._network(Decoding(steps=1)), 1))

    def begin(self, first: Video) -> Moment:
        video = first if self._has_depth else Video(first.rgb)
        grids = self._codec.encode(video)
        tokens = {name: grid.reshape(-1) for name, grid in grids.items()}
        cells = {name: jnp.asarray(row[None], jnp.int32) for name, row in tokens.items()}
        if self._arch.use_depth:
            cells.setdefault("depth", jnp.zeros_like(cells["rgb"]))
        state = self._place(replace(restart(self._empty, jnp.ones(1, bool), cells, self._empty.key), cache={}))
        seen = self._codec.decode_rgb(grids["rgb"])[0, 0]
        sums = np.zeros(len(self._codec.normalization.action_mean))
        return Moment(seen, tokens, None, _Memory(state, None, sums))

    def advance(
        self, moments: Sequence[Moment], actions: Float[np.ndarray, "N A"], decodings: Sequence[Decoding]
    ) -> list[Moment]:
        parts = [slice(start, start + self._width) for start in range(0, len(moments), self._width)]
        return [made for part in parts for made in self._advance(moments[part], actions[part], decodings[part])]

    def _advance(
        self, moments: Sequence[Moment], actions: Float[np.ndarray, "N A"], decodings: Sequence[Decoding]
    ) -> list[Moment]:
        """Advances moments in one run of the program."""
        count, full = len(moments), [*range(len(moments)), *[0] * (self._width - len(moments))]
        memories = [cast(_Memory, moments[i].memory) for i in full]
        scaled = self._codec.normalization.scaled(actions[full])
        sums = np.stack([memory.sums for memory in memories]) + scaled
        rows = with_sums(scaled, sums if self._config.departures.integrate_actions else None)
        net, chosen = self._network(decodings[0]), [decodings[i] for i in full]
        dials = Dials(
            np.array([each.temperature for each in chosen], np.float32),
            np.array([each.guidance for each in chosen], np.float32),
        )
        seeds = np.array([(each.seed, each.draw) for each in chosen], np.uint32)
        own = [memory.cache for memory in memories[:count]] + [None] * (self._width - count)
        caches = tuple(self._empty_cache() if cache is None else cache for cache in own)
        states = tuple(_fitted(net, memory.state) for memory in memories)
        codec = self._codec
        made, caches, rgb = _advance(net, codec.config, self._params, codec.params, caches, states, rows, seeds, dials)
        pictures = np.asarray(rgb)
        return [self._moment(_Memory(made[i], caches[i], sums[i]), pictures[i]) for i in range(count)]

    def lightened(self, moment: Moment) -> Moment:
        """Leaves out the cache if the window is full, as it is then encoded again; otherwise, the whole memory."""
        memory = moment.memory
        if memory is None or memory.cache is None:
            return moment
        full = not self._arch.departures.rotary and int(memory.state.position[0]) == self._arch.frames
        return replace(moment, memory=replace(memory, cache=None) if full else None)

    def depth(self, moment: Moment) -> Float32[np.ndarray, "H W"] | None:
        cells = (moment.means or moment.tokens).get("depth")
        if cells is None:
            return None
        return self._codec.decode_depth(cells.reshape(1, self._arch.grid, self._arch.grid, *cells.shape[1:]))[0]

    def _network(self, decoding: Decoding) -> Network:
        """Returns the settings of a decoding's program, which takes temperature and guidance as arguments.

        A model that can be guided always is, so that its cache always has the same shape.
        """
        drawn, guided = float(decoding.temperature > 0), 2.0 if self._arch.departures.action_dropout else 1.0
        sample = replace(self._config.sample, seed=0, temperature=drawn, guidance=guided)
        sample = replace(sample, steps=decoding.steps, top_k=decoding.top_k)
        return Network(self._arch, sample, self._has_depth, True)

    def _empty_cache(self) -> Cache:
        return jax.tree.map(jnp.copy, self._empty.cache)  # a pass uses up the cache that it gets

    def _moment(self, memory: _Memory, rgb: UInt8[np.ndarray, "H W 3"]) -> Moment:
        state = memory.state
        last = {
            kind: {name: np.asarray(cells[0, -1]) for name, cells in of.items() if name == "rgb" or self._has_depth}
            for kind, of in (("tokens", state.tokens), ("means", state.means))
        }
        size = sum(leaf.nbytes for leaf in jax.tree.leaves(memory.cache))
        return Moment(rgb, last["tokens"], np.asarray(cast(Array, state.entropy)[0]), memory, size, last["means"])


def program_clips(lanes: int) -> int:
    """Returns how many clips one run of the program generates."""
    return 1 if jax.default_backend() == "cpu" else lanes


def _fitted(net: Network, state: State) -> State:
    """Returns the state with mean codes if the settings show them; frames that have none get their tokens' codes."""
    if not net.sample.shows_means:
        return replace(state, means={})
    codes = {name: lfq.tokens_to_codes(cells, net.arch.code_bits) for name, cells in state.tokens.items()}
    return replace(state, means=state.means or codes)


@partial(jax.jit, static_argnums=(0, 1), donate_argnums=(4,))
def _advance(
    net: Network,
    tokenizer: TokenizerConfig,
    params: Params,
    tokenizer_params: Params,
    caches: tuple[Cache, ...],
    states: tuple[State, ...],
    actions: Float[Array, "N A"],
    seeds: Int[Array, "N 2"],
    dials: Dials,
) -> tuple[tuple[State, ...], tuple[Cache, ...], UInt8[Array, "N H W 3"]]:
    """Returns the states and caches after the next frame, and the frames."""
    keys = jax.vmap(lambda row: jax.random.fold_in(jax.random.key(row[0]), row[1]))(seeds)
    state: State = jax.tree.map(lambda *rows: jnp.concatenate(rows), *states)
    cache: Cache = jax.tree.map(lambda *clips: jnp.concatenate(clips, axis=1), *caches)
    state = advance(net, params, replace(state, cache=cache, key=keys), actions, dials)
    grid = last_frame(net, state, "rgb")
    pixels = cast(Array, Tokenizer(tokenizer).apply({"params": tokenizer_params}, grid, method="decode"))
    numbers = [slice(i, i + 1) for i in range(len(states))]
    parts = tuple(jax.tree.map(lambda x, at=at: x[at], replace(state, cache={})) for at in numbers)
    kept = tuple(jax.tree.map(lambda x, at=at: x[:, at], state.cache) for at in numbers)
    return parts, kept, jnp.round(pixels).astype(jnp.uint8)
