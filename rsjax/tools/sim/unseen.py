"""Collects clips of tasks, cameras and colours that training never saw, for a store of simulated clips.

The splits ``unseen_camera`` and ``unseen_color`` repeat the first episodes of the store's test split with the same
motion, but seen from another position or with objects in other colours; comparisons with the original clips are
therefore paired. ``unseen_task`` holds episodes of the held-out tasks (Meta-World only).
"""

from typing import Any

from rsjax.config import SimConfig, content_key, require
from rsjax.data.store import Store, open_store
from rsjax.tools.sim.collect import Collection, Report, collection_key, make_store
from rsjax.tools.sim.episode import EpisodePlan, task_of
from rsjax.tools.sim.scenery import PITCH, TURN, YAW, Change

FOLDER = "unseen"  # inside the store's directory, so that it moves with the store
CHANGES: dict[str, Change] = {"unseen_camera": "camera", "unseen_color": "color"}
RECIPE = 1  # raise when the same configuration gives different episodes
UNITS = ("depth_range", "action_mean", "action_std")


def collect_unseen(config: SimConfig, clips: Store, episodes: int, report: Report, workers: int = 0) -> Store:
    """Collects ``episodes`` clips for each split, unless they exist, and returns their store.

    Its splits are :func:`unseen_splits`. It has the depth range and action statistics of ``clips``, so that a model
    reads both stores alike. ``manifest["unseen"]`` says what is unseen in each split.

    Args:
        config: the configuration of ``clips``.
        clips: the store that training reads.
        report: called as episodes finish.
        workers: processes that simulate; 0: one per core.

    Raises:
        ConfigError: ``episodes`` is not between 1 and ``config.test_episodes``.
        UserError: as :func:`collect`; also if the camera is mounted on the arm, so that it cannot
            move.
    """
    require(
        0 < episodes <= config.test_episodes,
        f"{episodes} unseen clips were asked for; they are test episodes seen otherwise, of which sim.test_episodes "
        f"gives {config.test_episodes}",
    )
    key = content_key("unseen", RECIPE, collection_key(config), episodes)
    splits: dict[str, tuple[EpisodePlan, ...]] = {}
    first = config.episodes - config.test_episodes
    tasks = config.held_out_tasks
    for split in unseen_splits(config):
        if split in CHANGES:
            numbers = range(first, first + episodes)
            plans = [EpisodePlan(f"{split}-{i:06d}", i, task_of(config, i), CHANGES[split]) for i in numbers]
        else:
            new = range(config.episodes, config.episodes + episodes)
            plans = [EpisodePlan(f"{split}-{i:06d}", i, tasks[i % len(tasks)]) for i in new]
        splits[split] = tuple(plans)
    unseen: dict[str, dict[str, Any]] = {
        "unseen_task": {"tasks": list(config.held_out_tasks)},
        "unseen_camera": {"yaw_degrees_to_either_side": list(YAW), "pitch_degrees": list(PITCH)},
        "unseen_color": {"turn_of_hue": list(TURN)},
    }
    meta = {name: clips.manifest[name] for name in UNITS} | {
        "unseen": {split: unseen[split] for split in splits},
        "seen": collection_key(config),
    }
    out = clips.path / FOLDER / key
    make_store(Collection(key, config, splits, meta), out, report, workers)
    return open_store(out)


def unseen_splits(config: SimConfig) -> tuple[str, ...]:
    """Returns the names of the splits of :func:`collect_unseen`."""
    return (*(("unseen_task",) if config.held_out_tasks else ()), *CHANGES)
