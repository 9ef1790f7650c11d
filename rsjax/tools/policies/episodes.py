"""Episodes in a world model, each judged at every frame: the core of both environments.

Axes: B episodes, N of them, S×S pixels, A action dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float, Float32

from rsjax.clip import Video
from rsjax.config import Config
from rsjax.data.normalization import Normalization
from rsjax.errors import UserError
from rsjax.models.load_run import load
from rsjax.models.trained import TrainedModel
from rsjax.tools.policies.actions import OutOfRange, check_out_of_range, check_takes_actions, checked_actions
from rsjax.tools.policies.judging import judge_of
from rsjax.tools.policies.simulator import FAR, STEPS, UNIT, Observation
from rsjax.tools.policies.starts import Starts
from rsjax.tools.policies.verdicts import HISTORY, LABELS, Judge

SPREAD = 5.0  # actions of recordings are clipped to this many standard deviations around the mean


@dataclass(frozen=True)
class Settings:
    """Settings of an environment.

    Attributes:
        data_dir: the directory of simulated data sets, where a run on simulated clips finds its first frames.
        store: the new path of the run's store of ingested clips, if it was moved.
        split: the clips whose first frames episodes begin with.
        max_steps: steps after which an episode is truncated; it may be longer than the model's window.
        judge: decides reward and termination: a judge, the directory of a trained one, or "run" for the judge that
            ``experiments.judge`` trained for the run, if any. Without a judge, every reward is 0.
        out_of_range: whether actions outside the action space are clipped and counted ("clip"), or raise ("refuse").
    """

    data_dir: Path | str = "data"
    store: Path | str | None = None
    split: str = "test"
    max_steps: int = STEPS
    judge: Judge | Path | str | None = "run"
    out_of_range: OutOfRange = "clip"

    def __post_init__(self) -> None:
        if self.max_steps < 1:
            raise UserError(f"max_steps is {self.max_steps}; an episode has at least 1 step")
        check_out_of_range(self.out_of_range)


@dataclass(frozen=True)
class Step:
    """The result of one step of all B episodes.

    Attributes:
        seen: the observations.
        success: whether the judge sees that the task is done.
        over: whether an episode has had all its steps.
        info: as from :meth:`Episodes.info`, and "action": the actions after clipping.
    """

    seen: Observation
    success: Bool[np.ndarray, " B"]
    over: Bool[np.ndarray, " B"]
    info: dict[str, np.ndarray]


class Episodes:
    """B episodes in the world model of a run, stepped together on the device and restarted one by one.

    Args:
        run: a run directory, or its trained model.
        count: B; None for a single episode, whose actions have no leading axis.
        settings: the settings of the environment.

    Attributes:
        action_space: the action space of one episode.
        observation_space: the observation space of one episode.

    Raises:
        UserError: the run is missing or unfinished, its model takes no actions or cannot generate frame by frame, or
            the judge is missing, damaged or takes frames of another size.
    """

    def __init__(self, run: Path | str | TrainedModel, count: int | None, settings: Settings) -> None:
        self._lead = () if count is None else (count,)
        count = count or 1
        trained = run if isinstance(run, TrainedModel) else load(run)
        config, where = trained.config, Path("." if isinstance(run, TrainedModel) else run)
        check_takes_actions(config.model, "the model" if isinstance(run, TrainedModel) else f"{run}: the model")
        norm, size = trained.assets.normalization, config.clips.image_size
        self._imagination = trained.model.imagine(trained.params, trained.assets, count)
        self._depth = config.model.uses_depth and norm.depth_range is not None
        store = Path(settings.store) if settings.store else None
        self._starts = Starts(config, where, Path(settings.data_dir), store, settings.split, self._depth)
        self._settings, self._judge = settings, judge_of(run, settings.judge, size)
        self._low, self._high, self._unit = action_range(config, norm)
        self._recent = np.zeros((count, HISTORY, size, size, 3), np.uint8)
        self._steps, self._clipped = np.zeros(count, int), np.zeros(count, int)
        self._clip = np.full(count, -1)
        self.action_space = spaces.Box(self._low, self._high)
        shapes: dict[str, Any] = {"rgb": spaces.Box(0, 255, (size, size, 3), np.uint8)}
        if self._depth:
            shapes["depth"] = spaces.Box(0.0, max(FAR, norm.depth_range[1]), (size, size))  # type: ignore[index]
        self.observation_space = spaces.Dict(shapes)

    def restart(
        self, which: Bool[np.ndarray, " B"], rng: Sequence[np.random.Generator], options: dict[str, Any]
    ) -> Observation:
        """Restarts N episodes and returns their first observations, as the model sees them.

        Args:
            which: a mask of these episodes.
            rng: one generator for each of the N; it chooses the clip and the draws.
            options: as for the environments' ``reset``: "rgb" and "depth", or "clip"; "draw".

        Raises:
            StartError: the given frame does not fit, or the run's clips are missing.
        """
        starts = [self._starts.choose(each, options) for each in rng]
        draws = [int(options.get("draw", each.integers(2**31))) for each in rng]
        first = Video(
            np.concatenate([start.video.rgb for start in starts]),
            np.concatenate([start.video.depth for start in starts]) if self._depth else None,  # type: ignore[misc]
        )
        seen = self._imagination.restart(which, first, np.array(draws))
        self._recent[which] = seen.rgb  # the first frame, repeated
        self._steps[which] = self._clipped[which] = 0
        self._clip[which] = [start.clip for start in starts]
        return _observation(seen)

    def step(self, actions: Any, ignored: Bool[np.ndarray, " B"] | None = None) -> Step:
        """Generates the next frame of every episode.

        Args:
            actions: (B, A) in the recording's units; (A,) for a single episode.
            ignored: episodes whose actions do not matter.

        Raises:
            ActionError: the actions have the wrong shape or a value that is not finite, or are refused as out of range.
        """
        shape = (*self._lead, *self._low.shape)
        low, high = np.broadcast_to(self._low, shape), np.broadcast_to(self._high, shape)
        done, outside = checked_actions(actions, low, high, self._settings.out_of_range, self._unit, ignored)
        count = len(self._steps)
        video = self._imagination.step(done.reshape(count, -1))
        self._clipped += outside.reshape(count, -1).sum(1)
        self._recent = np.concatenate([self._recent[:, 1:], video.rgb], axis=1)
        self._steps += 1
        verdict = self.verdict()
        info = self.info(verdict) | {"action": done.reshape(count, -1)}
        return Step(_observation(video), info["success"], self._steps >= self._settings.max_steps, info)

    def verdict(self) -> Float[np.ndarray, "B 3"]:
        """Returns the probability of each label at the current frames; zeros without a judge."""
        if self._judge is None:
            return np.zeros((len(self._steps), len(LABELS)))
        return self._judge(self._recent)

    def info(self, verdict: Float[np.ndarray, "B 3"]) -> dict[str, np.ndarray]:
        """Returns the ``info`` of all episodes: label, its probabilities, success, numbers clipped so far, clip."""
        judged = self._judge is not None
        labels = [LABELS[i] for i in verdict.argmax(-1)] if judged else ["unjudged"] * len(verdict)
        return {
            "success": np.array(labels) == LABELS[0],
            "label": np.array(labels, object),
            "verdict": verdict,
            "clipped": self._clipped.copy(),
            "clip": self._clip.copy(),
        }


def action_range(
    config: Config, normalization: Normalization
) -> tuple[Float32[np.ndarray, " A"], Float32[np.ndarray, " A"], str]:
    """Returns the least and greatest actions, and their unit.

    Actions in the simulator range from -1 to 1. For recordings, a run knows only the actions' mean and standard
    deviation; their range is the mean ± ``SPREAD`` standard deviations.
    """
    width = config.clips.action_dim
    if not config.data.key:
        unit = UNIT if config.sim.env == "lift" else "controls of the simulator, from -1 to 1"
        return np.full(width, -1, np.float32), np.full(width, 1, np.float32), unit
    mean, std = np.array(normalization.action_mean), np.maximum(normalization.action_std, 1e-3)
    low, high = mean - SPREAD * std, mean + SPREAD * std
    return low.astype(np.float32), high.astype(np.float32), "in the recording's units, as the clips' actions"


def _observation(video: Video) -> Observation:
    seen = {"rgb": video.rgb[:, -1]}
    return seen if video.depth is None else seen | {"depth": video.depth[:, -1]}
