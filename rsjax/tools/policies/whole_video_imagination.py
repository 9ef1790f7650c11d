"""Lets policies act in models that generate only whole videos: each step generates a short video, keeps one frame.

Axes: B clips, P prompt frames, A action dimensions.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from rsjax.clip import Video
from rsjax.models.base import Imagination, WorldModel
from rsjax.models.trained import TrainedModel

DRAWS = 2**20  # added to a clip's index at each step, so that steps differ in their draws; clip indices are smaller


def imagination(trained: TrainedModel, clips: int) -> Imagination:
    """Returns an imagination that generates clips frame by frame, in the family's own way if it has one."""
    if type(trained.model).imagine is WorldModel.imagine:
        return Continued(trained)
    return trained.model.imagine(trained.params, trained.assets, clips)


class Continued:
    """Implements :class:`rsjax.models.base.Imagination` with ``generate``, for clips that begin together.

    The prompt of each new frame is the last P decoded frames, where P is the model's ``prompt_frames``. Earlier frames
    are forgotten, and quality drops a little with each decoding. A step costs as much as a video of P + 1 frames.
    """

    def __init__(self, trained: TrainedModel) -> None:
        self._trained, self._steps = trained, 0

    def restart(self, which: Bool[np.ndarray, " B"], first: Video, index: Int[np.ndarray, " B"]) -> Video:
        assert which.all(), "clips begin together"
        trained = self._trained
        self._frames = (trained.model.reconstruct(trained.assets, Video(first.rgb)) or first).rgb
        self._actions = np.zeros((len(which), 1, trained.config.clips.action_dim), np.float32)
        self._index, self._steps = np.asarray(index), 0
        return Video(self._frames)

    def step(self, actions: Float[np.ndarray, "B A"]) -> Video:
        trained, most = self._trained, self._trained.config.prompt_frames
        rows = np.concatenate([self._actions, actions[:, None]], axis=1)
        index = (self._index + self._steps * DRAWS) % 2**31
        inputs = (trained.params, trained.assets, Video(self._frames), rows)
        made = trained.model.generate(*inputs, index=index, depth=False).rgb[:, -1:]
        self._frames = np.concatenate([self._frames, made], axis=1)[:, -most:]
        self._actions, self._steps = rows[:, -most:], self._steps + 1
        return Video(made)
