"""Energies for the planner: a world model imagines where candidates lead, and a score measures the distance to a goal.

Axes: N candidates, P frames so far, H steps, F generated frames, S×S pixels, A action dimensions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Float32, UInt8

from rsjax.clip import Video
from rsjax.errors import UserError
from rsjax.evaluation.metrics.lpips import distances
from rsjax.models.trained import TrainedModel
from rsjax.tokenizers.lpips import load_lpips, min_size
from rsjax.tools.policies.judges.head_judge import HeadJudge, check_heads
from rsjax.tools.policies.judges.judge import HISTORY, SUCCESS, Judge
from rsjax.tools.policies.planning.planner import Energy

# From the last F frames of N generated videos to their scores (N,); lower is better.
Score: TypeAlias = Callable[[UInt8[np.ndarray, "N F S S 3"]], Float[np.ndarray, " N"]]


@dataclass(frozen=True)
class RecentFrames:
    """The last frames of an episode, which a planner reads.

    Attributes:
        rgb: the last frames.
        depth: of the same frames, metres; None if the model has no depth.
        actions: row t led to frame t; row 0 is not read.
        past: the actions that led from the episode's beginning into the first of these frames; none at the beginning.
    """

    rgb: UInt8[np.ndarray, "P S S 3"]
    depth: Float32[np.ndarray, "P S S"] | None
    actions: Float32[np.ndarray, "P A"]
    past: Float32[np.ndarray, "K A"] | None = None


def imagined(model: TrainedModel, score: Score, frames: int = HISTORY) -> Energy:
    """Returns an energy: the score of the video that a world model generates for each candidate.

    All candidates share the cache of the frames so far, and the random draws. The energy takes a :class:`RecentFrames`.

    Args:
        frames: how many of the last frames the score looks at.
    """

    return lambda recent, candidates: score(planned(model, recent, candidates, frames).rgb)


def success(model: TrainedModel, rule: HeadJudge | None = None) -> Energy:
    """Returns an energy: 1 - the mean over the horizon of the probability of success by the model's own head.

    The mean, since a planner that looks at the end alone may put success off for ever. The energy takes a
    :class:`RecentFrames`, and decodes no picture but the last.

    Args:
        rule: how the head decides; by default in single frames.

    Raises:
        UserError: the model has no state heads.
    """
    check_heads(model.config.model, "the model")
    head = rule or HeadJudge()

    def energy(recent: RecentFrames, candidates: Float[np.ndarray, "N H A"]) -> Float[np.ndarray, " N"]:
        state = planned(model, recent, candidates, 1).state
        assert state is not None
        frames = state.shape[1]
        before = frames - candidates.shape[1]  # the prompt's
        read = np.stack([head.read(state[:, : t + 1])[:, SUCCESS] for t in range(before, frames)])
        return 1 - read.mean(axis=0)

    return energy


def planned(model: TrainedModel, recent: RecentFrames, candidates: Float[np.ndarray, "N H A"], frames: int) -> Video:
    """Returns the last frames of the videos that the model generates for the candidates, and the states of all."""
    before = np.repeat(recent.actions[None], len(candidates), axis=0)
    prompt = Video(recent.rgb[None], None if recent.depth is None else recent.depth[None])
    actions = np.concatenate([before, candidates], axis=1)
    last = min(frames, candidates.shape[1])
    return model.model.plan(model.params, model.assets, prompt, actions, depth=False, last=last, past=recent.past)


def pixel_distance(goal: UInt8[np.ndarray, "S S 3"]) -> Score:
    """Returns a score: the mean squared difference between the last frame and a goal, both scaled to [0, 1]."""
    wanted = goal.astype(np.float32) / 255
    return lambda video: np.square(video[:, -1].astype(np.float32) / 255 - wanted).mean((1, 2, 3))


def token_distance(model: TrainedModel, goal: UInt8[np.ndarray, "S S 3"]) -> Score:
    """Returns a score: the share of bits in which the last frame's tokens differ from the tokens of a goal.

    Raises:
        UserError: the model has no tokens.
    """
    wanted = model.encode(goal[None])["rgb"]
    bits = model.config.tokenizer.code_bits

    def score(video: UInt8[np.ndarray, "N F S S 3"]) -> Float[np.ndarray, " N"]:
        tokens = model.encode(video[:, -1:])["rgb"]
        return np.bitwise_count(tokens ^ wanted).mean((1, 2, 3)) / bits

    return score


def lpips_distance(weights: Path, goal: UInt8[np.ndarray, "S S 3"]) -> Score:
    """Returns a score: LPIPS between the last frame and a goal.

    Raises:
        UserError: the file of weights is missing or damaged, or the frames are too small for its network.
    """
    params = load_lpips(weights)
    side = len(goal)
    if side < min_size(params):
        raise UserError(f"{weights}: frames have {side} pixels; this network needs {min_size(params)}")
    return lambda video: np.asarray(distances(params, np.broadcast_to(goal, video[:, -1].shape), video[:, -1]))


def judged(judge: Judge) -> Score:
    """Returns a score: 1 - the probability of success at the end of the video."""
    return lambda video: 1 - judge(video)[:, SUCCESS]
