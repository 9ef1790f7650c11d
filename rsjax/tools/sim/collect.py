"""Collects simulated episodes in parallel processes into a store of clips.

Each finished episode is a file in ``<out>.partial``, so that an interrupted collection resumes; at the end these files
are packed into one store. An episode on which the simulator fails is left out and named in the manifest.
"""

import functools
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.artifact import make_once
from rsjax.config import SimConfig, content_key, to_dict
from rsjax.data.store import Record, complete_key, decode, encode, encode_clip, write_store
from rsjax.errors import UserError
from rsjax.files import disk_guard, write_atomically
from rsjax.processes import WorkerDied, count_cores, run_items
from rsjax.tools.sim import metaworld
from rsjax.tools.sim.episode import ENVIRONMENTS, EpisodePlan, Simulators, run_episode, source_name, task_of
from rsjax.tools.sim.gl import choose_gl, share_cores
from rsjax.tools.sim.recipes.plans import training_plans, versions

# By simulator; raise when the same configuration gives different episodes.
RECIPES = {"lift": 7, "metaworld": 3, "rope": 1, "tabletop": 2}
MAX_FAILURES = 0.1  # share of the episodes; more failures than this mean a broken installation
Report = Callable[[int, int], None]  # called with (episodes done, episodes in all)


class CollectError(UserError):
    """The collection cannot be completed. The message names the reason and the cure."""


@dataclass(frozen=True)
class Collection:
    """The contents of a store of simulated episodes.

    Attributes:
        key: the store's content key.
        config: the simulator's configuration.
        splits: the episodes of each split.
        meta: manifest fields that replace those computed from the clips.
    """

    key: str
    config: SimConfig
    splits: Mapping[str, tuple[EpisodePlan, ...]]
    meta: Mapping[str, Any]

    @property
    def plans(self) -> tuple[EpisodePlan, ...]:
        return tuple(plan for plans in self.splits.values() for plan in plans)


def collection_key(config: SimConfig) -> str:
    """Returns the content key of the store that :func:`collect` makes."""
    modes = ENVIRONMENTS[config.env].modes
    return content_key(config.env, RECIPES[config.env], modes, config, *versions(config))


def collect(config: SimConfig, out: Path, report: Report, workers: int = 0) -> None:
    """Collects ``config.episodes`` episodes into a store at ``out``; the last ``test_episodes`` form its test split.

    The train split follows ``config.recipe``; the test split is the expert's, and the same whatever the recipe. Returns
    at once if ``out`` is a store made by the same configuration, and waits if another process is making it.

    Args:
        report: called as episodes finish.
        workers: processes that simulate; 0: one per core.

    Raises:
        GLError: there is no usable OpenGL library.
        MetaworldError: Meta-World is chosen but not installed.
        FileError: ``out`` cannot be written, e.g. on a full disk.
        CollectError: two worker processes die over an episode, or more than ``MAX_FAILURES`` of the episodes fail.
    """
    test = range(config.episodes - config.test_episodes, config.episodes)
    plans = {
        "train": training_plans(config),
        "test": tuple(EpisodePlan(f"{i:06d}", i, task_of(config, i)) for i in test),
    }
    make_store(Collection(collection_key(config), config, plans, {}), out, report, workers)


def make_store(what: Collection, out: Path, report: Report, workers: int = 0) -> None:
    """Makes a store of simulated episodes, as :func:`collect` documents it."""
    total = len(what.plans)
    if complete_key(out) == what.key:
        report(total, total)
        return
    choose_gl()
    if what.config.env == "metaworld":
        metaworld.load_metaworld()
    partial = out.with_name(f"{out.name}.partial")
    with make_once(partial, what.key, refuse=None, wait=True, temporary=True):
        if complete_key(out) == what.key:  # another process made it in the meantime
            report(total, total)
            return
        todo = [
            plan
            for plan in what.plans
            if not (_clip_file(partial, plan.name).exists() or _error_file(partial, plan.name).exists())
        ]
        report(total - len(todo), total)
        if todo:
            with disk_guard(partial):
                _simulate(what.config, partial, todo, total, report, workers)
        _pack(what, partial, out)


def _simulate(
    config: SimConfig, partial: Path, todo: list[EpisodePlan], total: int, report: Report, workers: int
) -> None:
    workers = min(workers or count_cores(), len(todo))
    done = total - len(todo)

    def settle(plan: EpisodePlan, died: WorkerDied | None) -> None:
        nonlocal done
        if died is not None:  # leaving the episode out would make the store depend on this machine's memory
            raise CollectError(
                f"simulator processes died over episode {plan.episode}, most likely for lack of memory, after {done} "
                f"of {total} episodes; run again with fewer runtime.workers (now {workers}), finished episodes are kept"
            )
        done += 1
        report(done, total)

    in_turn = sorted(todo, key=lambda plan: plan.task)  # so that a worker opens each task's scene once
    run_items(functools.partial(_open_simulator, config, partial, workers), in_turn, workers, settle)


def _open_simulator(config: SimConfig, partial: Path, workers: int) -> Callable[[EpisodePlan], None]:
    """Opens a worker's simulators, which take its share of the cores."""
    share_cores(workers)
    return functools.partial(_work, Simulators(config), config, partial)


def _work(simulators: Simulators, config: SimConfig, partial: Path, plan: EpisodePlan) -> None:
    """Simulates one episode and writes its clip, or the simulator's error, into ``partial``."""
    sim = simulators(plan.task)
    try:
        payload = encode(encode_clip(run_episode(sim, config, plan)))
    except (UserError, OSError, MemoryError):
        raise
    except Exception as error:  # any error of the simulator costs this episode only
        write_atomically(_error_file(partial, plan.name), f"{type(error).__name__}: {error}".encode())
    else:
        write_atomically(_clip_file(partial, plan.name), payload)


def _clip_file(partial: Path, name: str) -> Path:
    return partial / f"{name}.clip"


def _error_file(partial: Path, name: str) -> Path:
    return partial / f"{name}.error"


def _pack(what: Collection, partial: Path, out: Path) -> None:
    """Writes the finished episodes as one store."""
    failures = {path.stem: path.read_text() for path in sorted(partial.glob("*.error"))}
    total = len(what.plans)
    if len(failures) > MAX_FAILURES * total:
        shutil.rmtree(partial)
        raise CollectError(
            f"{len(failures)} of {total} episodes failed in the simulator, the first one with: "
            f"{next(iter(failures.values()))}; nothing was stored, check the installation with `make test`"
        )
    files = {
        split: [path for plan in plans if (path := _clip_file(partial, plan.name)).exists()]
        for split, plans in what.splits.items()
    }
    for split, clips in files.items():
        if what.splits[split] and not clips:
            raise CollectError(
                f"every episode of the split {split} failed in the simulator, the first one with: "
                f"{next(iter(failures.values()))}; raise the number of episodes"
            )
    source = source_name(what.config)
    config = to_dict(what.config)
    meta: dict[str, Any] = {"key": what.key, "source": source, "config": config, "quarantine": failures}
    if "train" in files:
        actions = []
        depths = []
        for record in _clips(files["train"]):
            depths += [float(record["depth"].min()), float(record["depth"].max())]
            actions.append(record["actions"][1:])  # frame 0 has no action
        flat = np.concatenate(actions).astype(np.float64)
        meta |= {"depth_range": [min(depths), max(depths)]}
        meta |= {"action_mean": flat.mean(0).tolist(), "action_std": flat.std(0).tolist()}
    tasks = set[str]()
    modes = Counter[str]()
    final = []
    ever = []
    for record in _clips([path for paths in files.values() for path in paths]):
        tasks.add(record["task"])
        modes[record["provenance"]["expert"]["mode"]] += 1
        final.append(bool(record["success"][-1]))
        ever.append(bool(record["success"].any()))
    meta |= {"tasks": sorted(tasks), "modes": dict(modes)}
    meta |= {"success_share": float(np.mean(final)), "success_ever_share": float(np.mean(ever))} | dict(what.meta)
    stamp = {"depth_range": meta["depth_range"]}
    splits = {
        split: (clip | {"provenance": clip["provenance"] | stamp} for clip in _clips(paths))
        for split, paths in files.items()
    }
    write_store(out, "clips", splits, meta, labels)


def labels(clip: Record) -> dict[str, str]:
    """Returns the labels by which a curriculum can choose a clip."""
    return {"task": clip["task"], "difficulty": clip["provenance"]["difficulty"]}


def _clips(paths: list[Path]) -> Iterator[Record]:
    return (decode(path.read_bytes()) for path in paths)
