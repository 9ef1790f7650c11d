"""A trained world model as a world: it generates frames, and a judge decides on success.

Axes: B episodes, P prompt frames, S×S pixels, A action dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from rsjax.clip import Video
from rsjax.config import content_key
from rsjax.errors import UserError
from rsjax.evaluation.coverage import Coverage, clip_distances
from rsjax.evaluation.results import fingerprint
from rsjax.models.base import Imagination, WorldModel
from rsjax.models.trained import TrainedModel
from rsjax.tools.policies.judges.head_judge import HeadJudge
from rsjax.tools.policies.judges.judge import LABELS, SUCCESS, Judge, frames_of, judge_key
from rsjax.tools.policies.worlds.actions import ActionRange, action_range
from rsjax.tools.policies.worlds.world import EpisodeRecord, WorldState

DRAWS = 2**20  # added to a clip's index at each step, so that steps differ in their draws; clip indices are smaller


@dataclass(frozen=True)
class FirstFrame:
    """The first frame of an episode in a world model.

    Attributes:
        rgb: the first frame.
        depth: its depth, metres; None for a model without depth.
        draw: a number that determines the model's draws; 0 gives the video of ``TrainedModel.generate``.
        clip: the clip's number in its split; -1 for a frame of no clip.
    """

    rgb: UInt8[np.ndarray, "S S 3"]
    depth: Float32[np.ndarray, "S S"] | None
    draw: int
    clip: int = -1


class ModelWorld:
    """Episodes in a world model, which start from first frames.

    Args:
        trained: a model that ``rsjax.load`` loaded.
        count: episodes that run together.
        judge: decides which frames show success, from the frames or from what the model's own head reads; without a
            judge none do.
        actions: the actions that it takes; by default those of its run.
        whole_videos: whether a family that generates only whole videos may serve, one short video for each frame.
        coverage: the bank of training clips from which the distance of episodes is measured; None: it is not.
        imagination: generates the frames of ``count`` clips; by default the model itself.
        depth: whether frames have depth, if the model generates it.

    Raises:
        UserError: the family cannot generate frame by frame, and ``whole_videos`` is False.
    """

    def __init__(
        self,
        trained: TrainedModel,
        count: int,
        judge: Judge | HeadJudge | None,
        actions: ActionRange | None = None,
        whole_videos: bool = True,
        coverage: Coverage | None = None,
        imagination: Imagination | None = None,
        depth: bool = True,
    ) -> None:
        self._shows_depth = depth
        self.count = count
        self.actions = actions or action_range(trained.config, trained.assets.normalization)
        self.validation: dict[str, Any] | None = getattr(judge, "validation", None)
        self._trained = trained
        self._judge = judge
        self._history = frames_of(judge)
        self._coverage = coverage
        self._imagination: Imagination
        if imagination is not None:
            self._imagination = imagination
        elif whole_videos and type(trained.model).imagine is WorldModel.imagine:
            self._imagination = WholeVideoImagination(trained)
        else:
            self._imagination = trained.model.imagine(trained.params, trained.assets, count, depth)

    @cached_property
    def key(self) -> str:
        limits = fingerprint((self.actions.low, self.actions.high))
        return content_key("imagined", 2, model_key(self._trained), judge_key(self._judge), limits)

    def reset(self, starts: Sequence[FirstFrame], which: Bool[np.ndarray, " B"] | None = None) -> WorldState:
        """Begins an episode from each first frame; the observations are these frames as the model sees them."""
        everything = which is None
        if which is None:
            self._running = len(starts)
            starts = [*starts, *[starts[-1]] * (self.count - len(starts))]  # one program serves any number
            which = np.ones(self.count, bool)
        depth = [start.depth for start in starts if start.depth is not None]
        first = Video(
            np.stack([start.rgb for start in starts])[:, None],
            np.stack(depth)[:, None] if len(depth) == len(starts) else None,
        )
        video = self._imagination.restart(which, first, np.array([start.draw for start in starts]))
        recent = np.repeat(np.asarray(video.rgb), self._history, axis=1)
        read = None
        if video.state is not None:
            read = np.repeat(video.state, self._history, axis=1)
        observation = _last_frame(video, self._shows_depth)
        if everything:
            self._recent = recent
            self._read = read
            self._observation = observation
        else:
            self._recent[which] = recent
            if self._read is not None:
                self._read[which] = read
            for name, frames in observation.items():
                merged = self._observation[name].copy()  # jax's own arrays cannot be written
                merged[which] = frames
                self._observation[name] = merged
        return self._state(np.zeros((self.count, len(self.actions.low)), np.float32), np.zeros(self.count, int))

    def step(self, actions: Float[np.ndarray, "B A"], ignored: Bool[np.ndarray, " B"] | None = None) -> WorldState:
        rows, outside = self.actions.clip(actions, self._running, ignored=ignored)
        spare = self.count - self._running
        rows = np.concatenate([rows, rows[-1:].repeat(spare, axis=0)])
        clipped = np.concatenate([outside.sum(1), np.zeros(spare, int)])
        video = self._imagination.step(rows)
        self._recent = np.concatenate([self._recent[:, 1:], video.rgb], axis=1)
        if self._read is not None and video.state is not None:
            self._read = np.concatenate([self._read[:, 1:], video.state], axis=1)
        self._observation = _last_frame(video, self._shows_depth)
        return self._state(rows, clipped)

    def unfamiliarity(self, episodes: Sequence[EpisodeRecord], frames: int) -> list[float]:
        if self._coverage is None:
            return []
        rgb = []
        depth = []
        actions = np.zeros((len(episodes), frames, len(self.actions.low)), np.float32)
        for number, episode in enumerate(episodes):
            rows = np.minimum(np.arange(frames), len(episode.rgb) - 1)  # the last frame goes on
            rgb.append(episode.rgb[rows])
            if episode.depth is not None:
                depth.append(episode.depth[rows])
            actions[number, : len(episode.rgb)] = episode.actions
        video = Video(np.stack(rgb), np.stack(depth) if depth else None)
        lengths = [len(episode.rgb) for episode in episodes]
        distances = clip_distances(self._trained, self._coverage, video, actions, lengths)
        return self._coverage.of_clips(distances)[1].tolist()

    def _state(self, actions: Float32[np.ndarray, "B A"], clipped: Int[np.ndarray, " B"]) -> WorldState:
        running = slice(self._running)
        success = np.zeros(self._running, bool)
        verdict = None
        read = None
        if self._read is not None:
            read = self._read[running, -1]
        if isinstance(self._judge, HeadJudge):
            assert self._read is not None
            verdict = self._judge.read(self._read)[running]
        elif self._judge is not None:
            verdict = checked_verdict(self._judge(self._recent), self.count)[running]
        if verdict is not None:
            success = verdict.argmax(-1) == SUCCESS
        observation = {name: frames[running] for name, frames in self._observation.items()}
        return WorldState(observation, success, actions[running], clipped[running], verdict, read)


def checked_verdict(verdict: object, count: int) -> Float[np.ndarray, "B 3"]:
    """Returns a judge's answer about ``count`` videos.

    Raises:
        UserError: it is not the probabilities of the labels.
    """
    try:
        numbers = np.asarray(verdict, float)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != (count, len(LABELS)) or not np.isfinite(numbers).all():
        raise UserError(
            f"the judge returned {type(verdict).__name__} of shape {np.shape(numbers)}; it returns finite "
            f"probabilities of {', '.join(LABELS)} for each video, of shape {(count, len(LABELS))}"
        )
    return numbers


def _last_frame(video: Video, depth: bool) -> dict[str, np.ndarray]:
    frame = {"rgb": np.asarray(video.rgb)[:, -1]}
    if depth and video.depth is not None:
        frame["depth"] = np.asarray(video.depth)[:, -1]
    return frame


class WholeVideoImagination:
    """Implements :class:`rsjax.models.base.Imagination` with ``generate``, for clips that begin together.

    The prompt of each new frame is the last P decoded frames, where P is the model's ``prompt_frames``. Earlier frames
    are forgotten, and quality drops a little with each decoding. A step costs as much as a video of P + 1 frames.
    """

    def __init__(self, trained: TrainedModel) -> None:
        self._trained = trained
        self._depth = trained.config.model.uses_depth

    def restart(self, which: Bool[np.ndarray, " B"], first: Video, index: Int[np.ndarray, " B"]) -> Video:
        assert which.all(), "clips begin together"
        trained = self._trained
        prompt = first if self._depth else Video(first.rgb)
        self._frames = trained.model.reconstruct(trained.assets, prompt) or prompt
        self._actions = np.zeros((len(which), 1, trained.config.clips.action_dim), np.float32)
        self._index = np.asarray(index)
        self._steps = 0
        return self._frames

    def step(self, actions: Float[np.ndarray, "B A"]) -> Video:
        trained = self._trained
        prompt_frames = trained.config.prompt_frames
        rows = np.concatenate([self._actions, actions[:, None]], axis=1)
        index = (self._index + self._steps * DRAWS) % 2**31
        video = trained.model.generate(
            trained.params, trained.assets, self._frames, rows, index=index, depth=self._depth
        )
        frame = video.frames(-1)
        rgb = np.concatenate([self._frames.rgb, frame.rgb], axis=1)
        depth = None
        if self._frames.depth is not None and frame.depth is not None:
            depth = np.concatenate([self._frames.depth, frame.depth], axis=1)
        self._frames = Video(rgb, depth).frames(-prompt_frames)
        self._actions = rows[:, -prompt_frames:]
        self._steps += 1
        return frame


def model_key(trained: TrainedModel) -> str:
    """Returns the key of all that a world model's videos depend on: weights, tokenizer, normalization and settings."""
    config = trained.config
    assets = trained.assets
    settings = (config.prompt_frames, config.clips, config.tokenizer, config.model)
    weights = fingerprint((trained.params, assets.tokenizer))
    return content_key("model", str(settings), str(assets.normalization), weights)
