"""Generates a client's frames with those of others: an episode whose steps the playground's engine makes.

Axes: S×S pixels, A action dimensions.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from rsjax.clip import Video
from rsjax.models.branch_states import BranchState, Decoding
from rsjax.tools.play.engine import Engine, FrameRequest


class SharedSteps:
    """Implements :class:`rsjax.models.base.Imagination` for one clip.

    Each step waits in the engine's queue. Steps of several clients that wait together are one pass of the model.

    Args:
        engine: generates the frames of all clients.
        decoding: how frames are decoded; ``draw`` is replaced by that of the episode.
    """

    def __init__(self, engine: Engine, decoding: Decoding) -> None:
        self._engine = engine
        self._decoding = decoding
        self._has_depth = False
        self._draw = 0
        self._state: BranchState | None = None

    def restart(self, which: Bool[np.ndarray, "1"], first: Video, index: Int[np.ndarray, "1"]) -> Video:
        self._has_depth = first.depth is not None
        self._draw = int(index[0])
        self._state = self._engine.begin(first)
        return self._frame(self._state)

    def step(self, actions: Float[np.ndarray, "1 A"]) -> Video:
        assert self._state is not None, "restart the clip first"
        decoding = replace(self._decoding, draw=self._draw)
        work = FrameRequest(self._state, actions[0], decoding, self._has_depth, lambda text, busy: None)
        self._state = self._engine.submit(work).result()
        return self._frame(self._state)

    def _frame(self, state: BranchState) -> Video:
        """Returns a frame with its depth, (1, 1, S, S, …), and what the state heads read."""
        rgb = state.rgb[None, None]
        read = None
        if state.state is not None:
            read = state.state[None, None]
        if not self._has_depth:
            return Video(rgb, state=read)
        depth = self._engine.branching(True).depth(state)
        assert depth is not None
        return Video(rgb, depth[None, None], state=read)
