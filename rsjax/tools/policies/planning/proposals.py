"""Candidates for a planner: what a policy does in the world model, and what followed similar frames of training clips.

Axes: B episodes, N candidates, H steps of the horizon, C clips, T frames, S×S pixels, K numbers of a small picture, A
action dimensions.
"""

import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from rsjax.data.clips import readable
from rsjax.data.codec import Record
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.evaluation.results import fingerprint
from rsjax.models.trained import TrainedModel
from rsjax.tools.policies.demos import Demos
from rsjax.tools.policies.planning.energies import RecentFrames, planned
from rsjax.tools.policies.policy import Policy
from rsjax.tools.policies.worlds.world import Actor, Observation

SIDE = 16  # pixels of the pictures in which frames are compared


def policy_rollouts(
    model: TrainedModel, policy: Policy, count: int, horizon: int, seed: int, recent: RecentFrames
) -> Float32[np.ndarray, "N H A"]:
    """Returns the actions of a policy that goes on from the last frames of an episode, in a world model.

    It acts in each of ``count`` videos with its own draws, and makes a new plan as often as in an episode.

    Args:
        seed: of the draws, which also depend on the frames.
    """
    draws = zlib.crc32(recent.rgb.tobytes(), seed) >> 1
    prompt = np.repeat(recent.rgb[None], count, axis=0)
    frames = prompt
    actions = np.zeros((count, 0, policy.action_dim), np.float32)
    while True:
        plans = policy.plans(frames, draws + actions.shape[1])
        actions = np.concatenate([actions, plans[:, : policy.executed_frames]], axis=1)
        if actions.shape[1] >= horizon:
            return actions[:, :horizon]
        observed = policy.model.config.observations
        frames = np.concatenate([prompt, planned(model, recent, actions, observed).rgb], axis=1)


@dataclass(frozen=True)
class SimilarClips:
    """Clips that succeed, to follow from the frame that is most like the present one.

    As in visual imitation by nearest neighbours (Pari et al. 2021), but in plain pixels.

    Attributes:
        pictures: their frames, small, in [0, 1].
        actions: row t led to frame t.
        before: the frames before their first success.
    """

    pictures: Float32[np.ndarray, "C T K"]
    actions: Float32[np.ndarray, "C T A"]
    before: Bool[np.ndarray, "C T"]

    @cached_property
    def key(self) -> str:
        """A hash of all that actions depend on."""
        return fingerprint((self.pictures, self.actions, self.before))

    def actor(self, seed: int = 0) -> Actor:
        """Returns an actor that looks for the most similar clip at every frame; it draws nothing."""

        def act(observation: Observation) -> Float32[np.ndarray, "B A"]:
            return np.concatenate([self.ways(frame, 1, 1)[:, 0] for frame in observation["rgb"]])

        return act

    def ways(self, frame: UInt8[np.ndarray, "S S 3"], count: int, horizon: int) -> Float32[np.ndarray, "N H A"]:
        """Returns what was done after the most similar frame of each of the ``count`` most similar clips, best first.

        There are fewer ways if there are fewer clips. Beyond its clip's end, a way goes on with the last action.
        """
        squares = np.square(self.pictures).sum(axis=-1)
        distances = np.where(self.before, squares - 2 * self.pictures @ _small(frame), np.inf)
        nearest = distances.argmin(axis=1)
        clips = distances.min(axis=1).argsort(kind="stable")[:count]
        rows = np.minimum(nearest[clips, None] + np.arange(1, horizon + 1), self.actions.shape[1] - 1)
        return self.actions[clips[:, None], rows]


def similar_clips(clips: Store) -> SimilarClips:
    """Reads the training clips that succeed after their first frame.

    Raises:
        UserError: there is none.
    """
    chosen = []
    for _, clip in readable(clips.source("train")):
        success = np.logical_or.accumulate(clip["success"])
        if success[-1] and not success[0]:
            chosen.append((clip, ~success))
    if not chosen:
        raise UserError(f"{clips.path}: none of its training clips succeeds, so a planner has none to begin with")
    return _similar(chosen)


def similar_demos(demos: Demos) -> SimilarClips:
    """Returns demonstrations to follow; nothing follows their last frames."""
    length = len(demos[0]["rgb"])
    return _similar((record, np.arange(length) < length - 1) for record in demos.records)


def _similar(chosen: Iterable[tuple[Record, Bool[np.ndarray, " T"]]]) -> SimilarClips:
    """Returns clips to follow from the frames that the masks name."""
    pictures = []
    actions = []
    before = []
    for clip, frames in chosen:
        pictures.append(np.stack([_small(frame) for frame in clip["rgb"]]))
        actions.append(clip["actions"])
        before.append(frames)
    return SimilarClips(np.stack(pictures), np.stack(actions), np.stack(before))


def _small(frame: UInt8[np.ndarray, "S S 3"]) -> Float32[np.ndarray, " K"]:
    return cv2.resize(frame, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32).ravel() / 255
