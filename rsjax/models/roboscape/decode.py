"""Decoding of single frames of a rollout, from the cache or by computing their window again.

Axes: B clips, T frames, S cells, A action dimensions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int, Key

from rsjax.clip import Array
from rsjax.config import ModelConfig, SampleConfig
from rsjax.models.roboscape.maskgit import Frame, unmask_step
from rsjax.models.roboscape.window import stride, window_actions, window_start
from rsjax.models.roboscape.world_model import Cache

Cells = dict[str, Int[Array, "B T S"]]


@dataclass(frozen=True)
class Decoder:
    """What the frames of a rollout have in common.

    Attributes:
        apply: the model, :func:`rsjax.models.roboscape.guidance.apply_guided` with its first arguments given.
        actions: into all frames.
        keys: one per clip.
        no_depth: True for clips without depth; ``apply`` knows of them too.
    """

    model: ModelConfig
    sample: SampleConfig
    apply: Callable[..., Any]
    actions: Float[Array, "B T A"]
    keys: Key[Array, " B"]
    no_depth: Bool[Array, " B"] | None

    def cached(self, base: Array | int, t: Array, carry: tuple[Cells, Cache]) -> tuple[Cells, Cache]:
        """Puts frame t into the tokens, from the cache of frames before t-1: a pass over (t-1, t), then over t alone.

        Args:
            base: the first frame of the window.
            carry: tokens of all frames, and the cache, in which t-1 is written for good and t is a draft.
        """
        tokens, cache = carry
        b, _, cells = tokens["rgb"].shape
        keys = self._step_keys(t)
        pair = {name: jax.lax.dynamic_slice_in_dim(grid, t - 1, 2, axis=1) for name, grid in tokens.items()}
        mask = jnp.broadcast_to(jnp.array([False, True])[None, :, None], (b, 2, cells))
        actions = window_actions(self.model, self.actions, base, t - 1, 2)
        logits, cache = self.apply(pair, mask, actions, t - 1 - base, cache)
        frame = Frame({name: grid[:, 1] for name, grid in pair.items()}, mask[:, 1])
        frame = self._unmask(keys[:, 0], 0, frame, {name: x[:, 1] for name, x in logits.items()})

        def step(i: Array, frame: Frame) -> Frame:
            one = {name: grid[:, None] for name, grid in frame.tokens.items()}
            logits, _ = self.apply(one, frame.mask[:, None], actions[:, 1:], t - base, cache)
            return self._unmask(keys[:, i], i, frame, {name: x[:, 0] for name, x in logits.items()})

        frame = jax.lax.fori_loop(1, self.sample.steps, step, frame)
        return _put(tokens, frame, t), cache

    def encode_anew(self, base: Array, carry: tuple[Cells, Cache]) -> tuple[Cells, Cache]:
        """Fills the cache with the frames that a window beginning at ``base`` keeps, but for the last of them."""
        tokens, cache = carry
        kept = self.model.frames - stride(self.model, self.sample) - 1
        if kept == 0:
            return carry
        held = {name: jax.lax.dynamic_slice_in_dim(grid, base, kept, axis=1) for name, grid in tokens.items()}
        actions = window_actions(self.model, self.actions, base, base, kept)
        _, cache = self.apply(held, jnp.zeros(held["rgb"].shape, bool), actions, 0, cache)
        return tokens, cache

    def uncached(self, t: Array, tokens: Cells) -> Cells:
        """Puts frame t into the tokens, from a full pass over its window at every step."""
        b, frames, cells = tokens["rgb"].shape
        length = frames if self.model.positions == "rotary" else self.model.frames
        base = window_start(self.model, self.sample, t)
        keys = self._step_keys(t)
        actions = window_actions(self.model, self.actions, base, base, length)
        frame = Frame({name: grid[:, 0] for name, grid in tokens.items()}, jnp.ones((b, cells), bool))

        def step(i: Array, frame: Frame) -> Frame:
            seen = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, base, length, axis=1), _put(tokens, frame, t))
            here = jnp.arange(length)[None, :, None] == t - base
            logits, _ = self.apply(seen, here & frame.mask[:, None], actions, 0, None)
            at_t = {
                name: jax.lax.dynamic_index_in_dim(x, t - base, axis=1, keepdims=False) for name, x in logits.items()
            }
            return self._unmask(keys[:, i], i, frame, at_t)

        return _put(tokens, jax.lax.fori_loop(0, self.sample.steps, step, frame), t)

    def _step_keys(self, t: Array) -> Key[Array, "B steps"]:
        return jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, t), self.sample.steps))(self.keys)

    def _unmask(self, keys: Array, step: Array | int, frame: Frame, logits: dict[str, Array]) -> Frame:
        return unmask_step(self.sample, self.model.code_bits, keys, step, frame, logits, self.no_depth)


def _put(tokens: Cells, frame: Frame, t: Array) -> Cells:
    """The frame's tokens at place t."""
    return {
        name: jax.lax.dynamic_update_slice_in_dim(grid, frame.tokens[name][:, None], t, axis=1)
        for name, grid in tokens.items()
    }
