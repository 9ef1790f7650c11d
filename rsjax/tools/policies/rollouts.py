"""Runs a policy in many episodes at a time, in the simulator or in a world model, and records success.

Axes: B episodes, T frames, S×S pixels, A action dimensions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from rsjax.clip import Video
from rsjax.config import content_key
from rsjax.progress import note
from rsjax.tools.policies.actions import checked_actions
from rsjax.tools.policies.keys import arrays_key, judge_key, model_key
from rsjax.tools.policies.simulator import UNIT, Episode
from rsjax.tools.policies.verdicts import SUCCESS, UNINTERPRETABLE, Judge, last_frames
from rsjax.tools.policies.whole_video_imagination import imagination

Acts = Callable[[UInt8[np.ndarray, "B S S 3"]], Float32[np.ndarray, "B A"]]
FIRST_SEED = 2**31  # of the test episodes; collected episodes have seeds from anywhere, so few coincide


@dataclass(frozen=True)
class Seen:
    """The state of B episodes after a step.

    Attributes:
        rgb: (B, S, S, 3).
        depth: (B, S, S), metres, or None.
        success: (B,), whether the task is done, as the world itself judges.
        actions: (B, A), the actions that led here, after clipping.
        clipped: (B,), how many numbers of these actions were clipped.
        uninterpretable: (B,), whether the judge cannot interpret the frames; None without a judge.
    """

    rgb: UInt8[np.ndarray, "B S S 3"]
    depth: Float32[np.ndarray, "B S S"] | None
    success: Bool[np.ndarray, " B"]
    actions: Float32[np.ndarray, "B A"]
    clipped: np.ndarray
    uninterpretable: Bool[np.ndarray, " B"] | None = None


class World(Protocol):
    """Something in which ``count`` episodes run together."""

    @property
    def count(self) -> int: ...

    @property
    def key(self) -> str:
        """A hash of all that success depends on except policy and starts: the simulator, or model and judge."""
        ...

    @property
    def validation(self) -> dict[str, Any] | None:
        """The validation of the world's judge, if it has one that was validated."""
        ...

    def restart(self, starts: Sequence[Any]) -> Seen:
        """Begins an episode from each of at most ``count`` starts."""
        ...

    def step(self, actions: Float32[np.ndarray, "B A"], over: Bool[np.ndarray, " B"]) -> Seen:
        """Runs one step of every episode; the results of episodes that are over do not matter."""
        ...


class Simulated:
    """Episodes in simulator environments, which start from seeds.

    An episode whose simulation diverges keeps its last state and does not succeed; a note says so.

    Args:
        envs: environments like :class:`rsjax.tools.policies.simulator.LiftEnv`.
        key: a hash of their settings.
    """

    validation = None

    def __init__(self, envs: Sequence[Any], key: str = "simulator") -> None:
        self._envs, self.key = list(envs), key
        self._last: list[tuple[Any, dict[str, Any]]] = []

    @property
    def count(self) -> int:
        return len(self._envs)

    def restart(self, starts: Sequence[int]) -> Seen:
        self._last = [env.reset(seed=int(seed)) for env, seed in zip(self._envs, starts, strict=False)]
        self._clipped, self._diverged = np.zeros(len(starts), int), set[int]()
        width = self._envs[0].action_space.shape[0]
        return self._seen(np.zeros((len(starts), width), np.float32))

    def step(self, actions: Float32[np.ndarray, "B A"], over: Bool[np.ndarray, " B"]) -> Seen:
        done = np.zeros((len(self._last), self._envs[0].action_space.shape[0]), np.float32)
        for number in np.flatnonzero(~over).tolist():
            if number in self._diverged:
                continue
            try:
                seen, _, _, _, info = self._envs[number].step(actions[number])
            except ArithmeticError as error:
                self._diverged.add(number)
                note(f"{error}; the episode stays as it was, and does not succeed")
            else:
                self._last[number], done[number] = (seen, info), info["action"]
        return self._seen(done)

    def _seen(self, done: Float32[np.ndarray, "B A"]) -> Seen:
        seen, infos = zip(*self._last, strict=True)
        clipped = np.array([info["clipped"] for info in infos])
        new, self._clipped = clipped - self._clipped, clipped
        depth = np.stack([each["depth"] for each in seen]) if "depth" in seen[0] else None
        success = np.array([bool(info["success"]) for info in infos])
        return Seen(np.stack([each["rgb"] for each in seen]), depth, success, done, new)


class Imagined:
    """Episodes in a world model, which start from first frames; a judge decides on success.

    Args:
        trained: a model that ``rsjax.load`` loaded.
        count: episodes that run together.
        judge: decides which frames show success.
        low, high: the least and greatest actions, (A,); numbers out of range are clipped and counted.
    """

    def __init__(self, trained: Any, count: int, judge: Judge, low: np.ndarray, high: np.ndarray) -> None:
        self._imagination = imagination(trained, count)
        self._count, self._judge, self._low, self._high = count, judge, low, high
        self.key = content_key("imagined", 2, model_key(trained), judge_key(judge), arrays_key(low, high))
        self.validation = getattr(judge, "validation", None)

    @property
    def count(self) -> int:
        return self._count

    def restart(self, starts: Sequence["FirstFrame"]) -> Seen:
        filled = [*starts, *[starts[-1]] * (self._count - len(starts))]
        maps = [start.depth for start in filled if start.depth is not None]
        depth = np.stack(maps)[:, None] if len(maps) == len(filled) else None
        first = Video(np.stack([start.rgb for start in filled])[:, None], depth)
        video = self._imagination.restart(np.ones(self._count, bool), first, np.array([s.draw for s in filled]))
        self._frames = np.asarray(video.rgb)
        self._alive = len(starts)
        return self._seen(video, np.zeros((self._count, len(self._low)), np.float32), np.zeros(self._count, int))

    def step(self, actions: Float32[np.ndarray, "B A"], over: Bool[np.ndarray, " B"]) -> Seen:
        given = np.concatenate([actions, actions[-1:].repeat(self._count - len(actions), 0)])
        low, high = (np.broadcast_to(end, given.shape[:1] + end.shape) for end in (self._low, self._high))
        done, _ = checked_actions(given, low, high, "clip", UNIT)
        video = self._imagination.step(done)
        self._frames = last_frames(np.concatenate([self._frames, video.rgb], 1))
        return self._seen(video, done, (done != given).sum(1))

    def _seen(self, video: Video, done: np.ndarray, clipped: np.ndarray) -> Seen:
        alive = slice(self._alive)
        verdict = self._judge(last_frames(self._frames))
        depth = None if video.depth is None else np.asarray(video.depth)[alive, -1]
        label = verdict.argmax(-1)[alive]
        rgb, spoilt = np.asarray(video.rgb)[alive, -1], label == UNINTERPRETABLE
        return Seen(rgb, depth, label == SUCCESS, done[alive], clipped[alive], spoilt)


@dataclass(frozen=True)
class FirstFrame:
    """A first frame for a world model: rgb (S, S, 3), depth (S, S) or None, and a number that determines the draws."""

    rgb: UInt8[np.ndarray, "S S 3"]
    depth: Float32[np.ndarray, "S S"] | None
    draw: int


def run_together(world: World, act: Acts, starts: Sequence[Any], steps: int) -> list[Episode]:
    """Runs at most ``world.count`` episodes together, each until it succeeds or has had all its steps.

    Raises:
        ActionError: the policy returns actions of the wrong shape, or a value that is not finite.
    """
    seen = world.restart(starts)
    over, ends = np.zeros(len(starts), bool), np.full(len(starts), steps)
    history = [replace(seen, success=over)]  # the policy has done nothing yet, whatever a judge says of the first frame
    for step in range(1, steps + 1):
        if over.all():
            break
        free = np.full(seen.actions.shape, np.inf, np.float32)
        actions, _ = checked_actions(act(seen.rgb), -free, free, "clip", UNIT)  # the world itself clips and counts
        seen = world.step(actions, over)
        history.append(seen)
        ends[seen.success & ~over] = step
        over = over | seen.success
    return [_episode(history, number, int(end)) for number, end in enumerate(ends)]


def _episode(history: list[Seen], number: int, end: int) -> Episode:
    mine = history[: end + 1]
    depth = None if mine[0].depth is None else np.stack([seen.depth[number] for seen in mine])  # type: ignore[index]
    return Episode(
        np.stack([seen.rgb[number] for seen in mine]),
        depth,
        np.stack([seen.actions[number] for seen in mine]),
        np.array([seen.success[number] for seen in mine]),
        int(sum(seen.clipped[number] for seen in mine)),
        bool(mine[-1].uninterpretable is not None and mine[-1].uninterpretable[number]),
    )


def run_all(
    world: World,
    actor: Callable[[int], Acts],
    starts: Sequence[Any],
    steps: int,
    keep: Callable[[int, Episode], None],
    report: Callable[[int], None] = lambda done: None,
) -> list[bool]:
    """Runs an episode from each start, ``world.count`` at a time, and returns which succeeded.

    Args:
        actor: makes an actor for new episodes, from a seed.
        keep: called with the number of each episode and the episode.
        report: called with the number of finished episodes.
    """
    results: list[bool] = []
    for first in range(0, len(starts), world.count):
        group = starts[first : first + world.count]
        for number, episode in enumerate(run_together(world, actor(first), group, steps), first):
            keep(number, episode)
            results.append(bool(episode.success.any()))
        report(len(results))
    return results
