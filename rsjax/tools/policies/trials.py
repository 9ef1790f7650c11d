"""Tries policies from the same starts, and saves which succeed so that an interrupted series of trials resumes."""

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.config import SimConfig, content_key
from rsjax.errors import UserError
from rsjax.evaluation.statistics import Estimate, wilson
from rsjax.files import making, read_json, write_file, write_json
from rsjax.progress import Progress
from rsjax.tools.policies.policy import Policy
from rsjax.tools.policies.rollouts import FIRST_SEED, FirstFrame, Simulated, World, run_all
from rsjax.tools.policies.simulator import Episode, LiftEnv
from rsjax.tools.studies.report.video import write_mp4

FPS = 5.0  # of the videos


@dataclass(frozen=True)
class Trials:
    """The same episodes for every policy.

    Attributes:
        episodes: episodes of each policy, from fixed seeds.
        max_steps: steps after which an episode counts as a failure.
        together: episodes that run at a time.
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
class Result:
    """The results of a policy's trials.

    Attributes:
        success: by episode.
        clipped: how many numbers of actions were clipped.
        uninterpretable: by episode, whether the judge cannot interpret its last frame; False in the simulator.
    """

    success: list[bool] = field(default_factory=list)
    clipped: int = 0
    uninterpretable: list[bool] = field(default_factory=list)

    @property
    def share(self) -> Estimate:
        """The share of successes with its Wilson interval."""
        return wilson(sum(self.success), len(self.success))


def try_policy(
    policy: Policy,
    world: World,
    starts: Sequence[Any],
    trials: Trials,
    folder: Path,
    name: str,
    see: Callable[[int, Episode], None] = lambda number, episode: None,
) -> Result:
    """Runs a policy from each start, except those whose result is in ``folder`` already.

    Args:
        folder: the folder of ``success.json``, which grows as episodes end, and of a few videos.
        name: for the progress line.
        see: called with the number of each episode that this call runs, and the episode.

    Raises:
        UserError: the result in ``folder`` is from other trials, another policy, or another world or judge.
        FileError: another process runs trials in ``folder``.
    """
    file = folder / "success.json"
    with making(folder, wait=False):
        kept = _kept(file, [len(starts), trials.max_steps, trials.together], content_key(policy.key, world.key))
        begins = len(kept["success"])
        with Progress(f"{name}: trials", len(starts), "episodes", begins) as progress:

            def keep(number: int, episode: Episode) -> None:
                kept["success"].append(bool(episode.success.any()))
                kept["uninterpretable"].append(bool(episode.uninterpretable))
                kept["clipped"] += episode.clipped
                if begins + number < trials.videos:
                    write_mp4(folder / f"episode-{begins + number:02d}.mp4", episode.rgb, FPS, 4)
                see(begins + number, episode)

            def report(done: int) -> None:
                write_json(file, kept)
                progress.update(begins + done, success=sum(kept["success"]))

            # An episode's draws depend on its group, so a resumed series continues at a multiple of ``together``.
            run_all(world, lambda first: policy.actor(begins + first), starts[begins:], trials.max_steps, keep, report)
    success, spoilt = ([bool(one) for one in kept[name]] for name in ("success", "uninterpretable"))
    return Result(success, int(kept["clipped"]), spoilt)


def _kept(file: Path, settings: list[int], key: str) -> dict[str, Any]:
    """Returns the content of the file of results so far, or an empty one's content if there is no file."""
    empty = {"success": [], "uninterpretable": [], "clipped": 0, "trials": settings, "key": key}
    kept = read_json(file, cure=f"delete {file}") if file.exists() else empty
    if kept.get("trials") != settings:
        raise UserError(f"{file}: is of (episodes, steps, together) {kept.get('trials')}, not {settings}; delete it")
    if kept.get("key") != key:
        older = "" if "key" in kept else ", or of an older version of rsjax"
        raise UserError(
            f"{file}: is of another policy, simulator, world model or judge{older}; choose another --out, or delete it"
        )
    return kept


@contextmanager
def lift_simulators(config: SimConfig, trials: Trials) -> Iterator[Simulated]:
    """Opens Lift environments in the simulator and closes them afterwards."""
    envs: list[LiftEnv] = []
    try:
        for _ in range(min(trials.together, trials.episodes)):
            envs.append(LiftEnv(config, max_steps=trials.max_steps))
        yield Simulated(envs, content_key("lift", config))
    finally:
        for env in envs:
            env.close()


def first_frames(world: World, seeds: Sequence[int], file: Path) -> list[FirstFrame]:
    """Returns the simulator's first frames for these seeds, from the file if it has those of this simulator."""
    if file.exists():
        with np.load(file) as arrays:
            if arrays["seeds"].tolist() == list(seeds) and "key" in arrays and str(arrays["key"]) == world.key:
                return _frames(arrays["rgb"], arrays["depth"])
    rgb, depth = [], []
    for first in range(0, len(seeds), world.count):
        seen = world.restart(seeds[first : first + world.count])
        rgb.append(seen.rgb)
        depth.append(np.zeros((len(seen.rgb), 0)) if seen.depth is None else seen.depth)
    stacked = np.concatenate(rgb), np.concatenate(depth)
    save_arrays(file, key=np.array(world.key), seeds=np.array(seeds), rgb=stacked[0], depth=stacked[1])
    return _frames(*stacked)


def save_arrays(file: Path, **arrays: np.ndarray) -> None:
    """Writes an .npz file, atomically."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    write_file(file, buffer.getvalue())


def _frames(rgb: np.ndarray, depth: np.ndarray) -> list[FirstFrame]:
    return [
        FirstFrame(one, two if two.size else None, number)
        for number, (one, two) in enumerate(zip(rgb, depth, strict=True))
    ]
