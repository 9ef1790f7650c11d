"""Candidates that a policy proposes to a planner: what it does itself, in the world model.

Axes: N candidates, H steps of the horizon, P frames so far, A action dimensions.
"""

import zlib

import numpy as np
from jaxtyping import Float32

from rsjax.models.trained import TrainedModel
from rsjax.tools.policies.planning.energies import RecentFrames, planned
from rsjax.tools.policies.policy import Policy


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
