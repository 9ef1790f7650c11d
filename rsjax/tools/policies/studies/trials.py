"""Tries policies from the same starts, and saves which succeed so that an interrupted series of trials resumes."""

import io
import itertools
from collections.abc import Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.artifact import make_once
from rsjax.clip import GENERATED_MARK
from rsjax.config import SimConfig, content_key
from rsjax.errors import UserError
from rsjax.files import write_file
from rsjax.processes import count_cores
from rsjax.progress import Progress
from rsjax.tools.policies.policy import Policy
from rsjax.tools.policies.worlds.model_world import FirstFrame, ModelWorld
from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld
from rsjax.tools.policies.worlds.world import FIRST_SEED, Actor, Observation, World, run_episodes
from rsjax.tools.studies.report.video import write_mp4

FPS = 5.0  # of the videos
HELD = 2  # steps for which a replay holds its last action: a judge may see a success a step before the simulator
OTHERS = (
    "holds trials of other episodes or steps, or of another policy, simulator, world model or judge; choose another "
    "--out, or delete it"
)


@dataclass(frozen=True)
class Trials:
    """The same episodes for every policy.

    Attributes:
        episodes: episodes of each policy, from fixed seeds.
        max_steps: steps after which an episode counts as a failure.
        together: episodes that run at a time; those in the simulator share all cores.
        videos: how many episodes are saved as videos.
    """

    episodes: int = 50
    max_steps: int = 30
    together: int = 5
    videos: int = 3

    def __post_init__(self) -> None:
        for name in ("episodes", "max_steps", "together"):
            if getattr(self, name) < 1:
                raise UserError(f"--{name.replace('_', '-')} is {getattr(self, name)}; it must be at least 1")

    @property
    def seeds(self) -> list[int]:
        """The simulator's seeds."""
        return [FIRST_SEED + number for number in range(self.episodes)]


@dataclass
class TrialResult:
    """The results of a policy's trials.

    Attributes:
        success: by episode.
        clipped: how many numbers of actions were clipped.
        uninterpretable: by episode, whether the judge cannot interpret its last frame; False in the simulator.
        unfamiliarity: by episode, how far it is from the world model's training clips, as a percentile, 0 to 1; empty
            if that is not measured.
    """

    success: list[bool] = field(default_factory=list)
    clipped: int = 0
    uninterpretable: list[bool] = field(default_factory=list)
    unfamiliarity: list[float] = field(default_factory=list)


def try_policy(
    policy: Policy,
    world: World,
    starts: Sequence[Any],
    trials: Trials,
    folder: Path,
    name: str,
    save_frames: int = 0,
) -> TrialResult:
    """Runs a policy from each start, except those whose result is in ``folder`` already.

    Args:
        folder: the folder of the results, which grow as episodes end, and of a few videos.
        name: for the progress line.
        save_frames: of how many episodes, from the first on, to save frames and actions as ``episode-NN.npz``, for
            other judges and :func:`replayed`.

    Raises:
        UserError: the result in ``folder`` is from other trials, another policy, or another world or judge.
        FileError: another process runs trials in ``folder``.
    """
    key = content_key("trials with actions", len(starts), trials.max_steps, trials.together, policy.key, world.key)
    with make_once(folder, key, refuse=OTHERS) as work:
        success: list[bool] = work.metadata.get("success", [])
        uninterpretable: list[bool] = work.metadata.get("uninterpretable", [])
        unfamiliarity: list[float] = work.metadata.get("unfamiliarity", [])
        clipped = work.metadata.get("clipped", 0)
        comment = ""
        if isinstance(world, ModelWorld):
            comment = GENERATED_MARK
        with Progress(f"{name}: trials", len(starts), "episodes", len(success)) as progress:
            # An episode's draws depend on its group, so a resumed series continues at a multiple of ``together``.
            for first in range(len(success), len(starts), world.count):
                group = starts[first : first + world.count]
                episodes = run_episodes(world, policy.actor(first), group, trials.max_steps)
                for number, episode in enumerate(episodes, first):
                    if number < trials.videos:
                        write_mp4(folder / f"episode-{number:02d}.mp4", episode.rgb, FPS, 4, comment)
                    if number < save_frames:
                        save_arrays(episode_file(folder, number), rgb=episode.rgb, actions=episode.actions)
                # New lists: what was saved before stays as it was if this group is interrupted.
                success = success + [bool(episode.success.any()) for episode in episodes]
                uninterpretable = uninterpretable + [episode.uninterpretable for episode in episodes]
                unfamiliarity = unfamiliarity + world.unfamiliarity(episodes, trials.max_steps + 1)
                clipped += sum(episode.clipped for episode in episodes)
                work.save(
                    success=success, uninterpretable=uninterpretable, clipped=clipped, unfamiliarity=unfamiliarity
                )
                progress.update(len(success), success=sum(success))
    if len(unfamiliarity) < len(success):  # episodes that another command has run
        unfamiliarity = []
    return TrialResult(success, clipped, uninterpretable, unfamiliarity)


def episode_file(folder: Path, number: int) -> Path:
    """Returns the file of an episode's frames and actions in a folder of :func:`try_policy`."""
    return folder / f"episode-{number:02d}.npz"


def replayed(simulator: World, recorded: Path, trials: Trials, folder: Path, name: str) -> list[bool]:
    """Replays in the simulator what a policy did in a world model from the same starts; keeps the results.

    Args:
        recorded: the folder of the episodes in the world model.
        folder: the folder of the results.
        name: for the progress line.

    Returns:
        By episode, whether the simulator's task is done by these actions.

    Raises:
        UserError: the results in ``folder`` are from other episodes or another simulator, or an episode's file is
            missing.
    """
    actions = []
    for number in range(trials.episodes):
        file = episode_file(recorded, number)
        if not file.exists():
            raise UserError(f"{file}: not there, though these trials are finished; delete {recorded} to run them again")
        with np.load(file) as arrays:
            actions.append(arrays["actions"][1:])
    made = content_key("replayed", 2, simulator.key, [rows.tolist() for rows in actions])
    with make_once(folder, made, refuse=OTHERS) as work:
        success: list[bool] = work.metadata.get("success", [])
        with Progress(f"{name}: replays", trials.episodes, "episodes", len(success)) as progress:
            for first in range(len(success), trials.episodes, simulator.count):
                group = actions[first : first + simulator.count]
                steps = min(max(map(len, group)) + HELD, trials.max_steps)
                seeds = trials.seeds[first : first + simulator.count]
                episodes = run_episodes(simulator, repeat_actions(group), seeds, steps)
                # Not what happens after its end while a longer episode of its group goes on.
                ends = [len(one) + HELD + 1 for one in group]
                success = success + [
                    bool(episode.success[:end].any()) for episode, end in zip(episodes, ends, strict=True)
                ]
                work.save(success=success)
                progress.update(len(success), success=sum(success))
    return success


def repeat_actions(actions: Sequence[np.ndarray]) -> Actor:
    """Returns an actor that does what the rows of each episode say, holds the last, and then rests."""
    steps = itertools.count()

    def act(observation: Observation) -> np.ndarray:
        step = next(steps)
        rows = [one[min(step, len(one) - 1)] * (step < len(one) + HELD) for one in actions]
        return np.stack(rows)

    return act


def open_lift(config: SimConfig, trials: Trials) -> AbstractContextManager[SimulatorWorld]:
    """Opens the simulators that trials need, on all cores, and closes them after the ``with`` block."""
    return closing(SimulatorWorld.lift(config, min(trials.together, trials.episodes), count_cores()))


def first_frames(world: World, seeds: Sequence[int], file: Path) -> list[FirstFrame]:
    """Returns the simulator's first frames for these seeds, from the file if it has those of this simulator."""
    if file.exists():
        with np.load(file) as arrays:
            if arrays["seeds"].tolist() == list(seeds) and "key" in arrays and str(arrays["key"]) == world.key:
                return _frames(arrays["rgb"], arrays["depth"])
    rgb = []
    depth = []
    for first in range(0, len(seeds), world.count):
        observation = world.reset(seeds[first : first + world.count]).observation
        rgb.append(observation["rgb"])
        depth.append(observation["depth"])
    save_arrays(
        file, key=np.array(world.key), seeds=np.array(seeds), rgb=np.concatenate(rgb), depth=np.concatenate(depth)
    )
    return _frames(np.concatenate(rgb), np.concatenate(depth))


def save_arrays(file: Path, **arrays: np.ndarray) -> None:
    """Writes an .npz file, atomically."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    write_file(file, buffer.getvalue())


def _frames(rgb: np.ndarray, depth: np.ndarray) -> list[FirstFrame]:
    return [
        FirstFrame(frame, distances, number) for number, (frame, distances) in enumerate(zip(rgb, depth, strict=True))
    ]
