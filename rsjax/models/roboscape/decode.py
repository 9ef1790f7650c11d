"""Decodes single frames of a rollout, with the cache or by recomputing their window.

Axes: B clips, T frames, S cells, D code bits, A action dimensions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, Key

from rsjax.clip import Array
from rsjax.config import SampleConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.maskgit import Frame, unmask_step
from rsjax.models.roboscape.transformer import Cache
from rsjax.models.roboscape.window import stride, window_actions, window_start

Cells = dict[str, Int[Array, "B T S"]]
Means = dict[str, Float[Array, "B T S D"]]  # mean codes; empty unless ``sample.shows_means``


@dataclass(frozen=True)
class Decoder:
    """Decodes the frames of one rollout.

    Attributes:
        apply: the network: :func:`rsjax.models.roboscape.guidance.apply_guided` with architecture, settings, parameters
            and ``no_depth`` bound.
        actions: those that lead into all frames.
        keys: one per clip.
        no_depth: True for clips without depth.
        temperature: one per clip, above 0, instead of that of ``sample``.
        entropy: whether :meth:`decode_pair` returns its frame's entropy.
    """

    arch: Architecture
    sample: SampleConfig
    apply: Callable[..., Any]
    actions: Float[Array, "B T A"]
    keys: Key[Array, " B"]
    no_depth: Bool[Array, " B"] | None
    temperature: Float[Array, " B"] | None = None
    entropy: bool = False

    def cached(self, base: Array | int, t: Array, carry: tuple[Cells, Means, Cache]) -> tuple[Cells, Means, Cache]:
        """Decodes frame t with the cache of the frames before it, except the last ``arch.uncommitted``.

        Args:
            base: the first frame of the window.
            carry: tokens and means of all frames, and the cache.
        """
        tokens, means, cache = carry
        read = self._read(tokens, means)
        pair = {name: jax.lax.dynamic_slice_in_dim(grid, t - 1, 2, axis=1) for name, grid in read.items()}
        actions = window_actions(self.arch, self.actions, base, t - 1, 2)
        before = {name: grid[:, t - 2] for name, grid in read.items()}
        frame, cache = self.decode_pair(pair, before, actions, t - base, self._step_keys(t), cache)
        return _put(tokens, frame.tokens, t), _put(means, frame.means, t), cache

    def decode_pair(
        self,
        pair: Cells | Means,
        before: Cells | Means,
        actions: Float[Array, "B 2 A"],
        position: Array | int,
        keys: Key[Array, "B steps"],
        cache: Cache,
    ) -> tuple[Frame, Cache]:
        """Decodes the second of two frames: a pass over both commits the first, then passes cover the second alone.

        What the first pass writes into the cache for the second frame is overwritten later. With ``whole_frames``
        it is final, and the pass leaves out the first frame, which is in the cache already.

        Args:
            pair: tokens of both frames, or mean codes if ``sample.reads_means``; the second's have no effect.
            before: the same of the frame before both, without T, for ``read_previous``; not read if the first frame
                begins its window.
            actions: those that lead into both frames, as in the window.
            position: that of the second frame in the window.
            cache: of the frames before the first one; with ``whole_frames``, of those before the second.
        """
        b, _, cells = pair["rgb"].shape[:3]
        first = 1 - self.arch.uncommitted  # frame of the pass
        mask = jnp.broadcast_to(jnp.array([False, True])[None, :, None], (b, 2, cells))
        previous = {name: jnp.stack([before[name], grid[:, 0]], axis=1) for name, grid in pair.items()}
        seen, rows, known = jax.tree.map(lambda x: x[:, first:], (pair, actions, previous))
        logits, cache = self.apply(seen, mask[:, first:], rows, position - 1 + first, cache, previous=known)
        entropy = jnp.zeros((b, cells)) if self.entropy else None
        undecided = {name: jnp.zeros((b, cells), jnp.int32) for name in pair}
        frame = Frame(undecided, mask[:, 1], entropy, no_means(self.arch, self.sample, b))
        frame = self._unmask(keys[:, 0], 0, frame, {name: x[:, -1] for name, x in logits.items()})
        previous = {name: grid[:, 1:] for name, grid in previous.items()}

        def step(i: Array, frame: Frame) -> Frame:
            one = {name: grid[:, None] for name, grid in self._read(frame.tokens, frame.means).items()}
            logits, _ = self.apply(one, frame.mask[:, None], actions[:, 1:], position, cache, previous=previous)
            return self._unmask(keys[:, i], i, frame, {name: x[:, 0] for name, x in logits.items()})

        return jax.lax.fori_loop(1, self.sample.steps, step, frame), cache

    def encode_anew(self, base: Array, carry: tuple[Cells, Means, Cache]) -> tuple[Cells, Means, Cache]:
        """Fills the cache with the frames that a window beginning at ``base`` keeps."""
        tokens, means, cache = carry
        length = self.arch.frames - stride(self.arch, self.sample) - self.arch.uncommitted
        if length == 0:
            return carry
        read = self._read(tokens, means)
        kept = {name: jax.lax.dynamic_slice_in_dim(grid, base, length, axis=1) for name, grid in read.items()}
        actions = window_actions(self.arch, self.actions, base, base, length)
        _, cache = self.apply(kept, jnp.zeros(kept["rgb"].shape[:3], bool), actions, 0, cache)
        return tokens, means, cache

    def uncached(self, t: Array, carry: tuple[Cells, Means]) -> tuple[Cells, Means]:
        """Decodes frame t with a full pass over its window at every step."""
        tokens, means = carry
        b, frames, cells = tokens["rgb"].shape
        length = frames if self.arch.departures.rotary else self.arch.frames
        base = window_start(self.arch, self.sample, t)
        keys = self._step_keys(t)
        actions = window_actions(self.arch, self.actions, base, base, length)
        given = {name: grid[:, 0] for name, grid in tokens.items()}
        frame = Frame(given, jnp.ones((b, cells), bool), None, no_means(self.arch, self.sample, b))

        def step(i: Array, frame: Frame) -> Frame:
            grids = _put(self._read(tokens, means), self._read(frame.tokens, frame.means), t)
            seen = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, base, length, axis=1), grids)
            here = jnp.arange(length)[None, :, None] == t - base
            logits, _ = self.apply(seen, here & frame.mask[:, None], actions, 0, None)
            at_t = {
                name: jax.lax.dynamic_index_in_dim(x, t - base, axis=1, keepdims=False) for name, x in logits.items()
            }
            return self._unmask(keys[:, i], i, frame, at_t)

        frame = jax.lax.fori_loop(0, self.sample.steps, step, frame)
        return _put(tokens, frame.tokens, t), _put(means, frame.means, t)

    def _read(self, tokens: dict[str, Array], means: dict[str, Array]) -> dict[str, Array]:
        """Returns the tokens or mean codes, whichever later passes read."""
        return means if self.sample.reads_means else tokens

    def _step_keys(self, t: Array) -> Key[Array, "B steps"]:
        return jax.vmap(lambda key: step_keys(self.sample, key, t))(self.keys)

    def _unmask(self, keys: Array, step: Array | int, frame: Frame, logits: dict[str, Array]) -> Frame:
        clips = (keys, step, frame, logits, self.no_depth, self.temperature)
        return unmask_step(self.sample, self.arch.code_bits, *clips)


def step_keys(sample: SampleConfig, key: Key[Array, ""], t: Array | int) -> Key[Array, " steps"]:
    """Returns the keys of the decoding steps of a clip's frame t."""
    return jax.random.split(jax.random.fold_in(key, t), sample.steps)


def no_means(arch: Architecture, sample: SampleConfig, clips: int) -> dict[str, Float[Array, "B S D"]]:
    """Returns zeros for a frame's mean codes by branch; empty if the settings do not ask for them."""
    shape = (clips, arch.grid**2, arch.code_bits)
    return {name: jnp.zeros(shape) for name in arch.branches if sample.shows_means}


def _put(grids: dict[str, Array], frame: dict[str, Array], t: Array) -> dict[str, Array]:
    """Returns the grids of all frames with this frame's at position t."""
    return {
        name: jax.lax.dynamic_update_slice_in_dim(grid, frame[name][:, None], t, axis=1) for name, grid in grids.items()
    }
