"""Collects clips of what training never saw, beside a store of simulated clips: other tasks, cameras and colours.

The splits ``unseen_camera`` and ``unseen_color`` are the first episodes of the store's test split again, with the same
motion, seen from another place or with the objects in other colours; the difference to those clips is therefore paired.
``unseen_task`` are episodes of the tasks that are held out (Meta-World alone).
"""

from typing import Any

from rsjax.config import SimConfig, content_key, require
from rsjax.data.store import Store, open_store
from rsjax.sim.collect import Collection, Report, collection_key, make_store
from rsjax.sim.episode import EpisodePlan, task_of
from rsjax.sim.scenery import PITCH, TURN, YAW, Change

FOLDER = "unseen"  # in the store's directory, with which it moves
CHANGES: dict[str, Change] = {"unseen_camera": "camera", "unseen_color": "color"}
RECIPE = 1  # to raise when the same configuration gives other episodes
UNITS = ("depth_range", "action_mean", "action_std")


def collect_unseen(config: SimConfig, clips: Store, episodes: int, report: Report) -> Store:
    """Collects ``episodes`` clips of each kind, unless they exist, and returns their store.

    Its splits are :func:`unseen_splits`; its depth range and action statistics are those of ``clips``, so that a model
    reads both alike. ``manifest["unseen"]`` says of each split what is held out.

    Args:
        config: the configuration of ``clips``.
        clips: the store of which these are the unseen ones.
        report: called as they finish.

    Raises:
        ConfigError: the store has fewer test episodes, or the camera that is to move rides on the arm.
        UserError: as :func:`rsjax.sim.collect.collect`.
    """
    require(
        0 < episodes <= config.test_episodes,
        f"{episodes} unseen clips were asked for; they are test episodes seen otherwise, of which sim.test_episodes "
        f"gives {config.test_episodes}",
    )
    key = content_key("unseen", RECIPE, collection_key(config), episodes)
    splits = {split: _plans(config, split, episodes) for split in unseen_splits(config)}
    meta = {name: clips.manifest[name] for name in UNITS} | {
        "unseen": _held_out(config),
        "seen": collection_key(config),
    }
    out = clips.path / FOLDER / key
    make_store(Collection(key, config, splits, meta), out, report)
    return open_store(out)


def unseen_splits(config: SimConfig) -> tuple[str, ...]:
    """Returns the names of the splits of :func:`collect_unseen`."""
    return (*(("unseen_task",) if config.held_out_tasks else ()), *CHANGES)


def _plans(config: SimConfig, split: str, episodes: int) -> tuple[EpisodePlan, ...]:
    if split in CHANGES:
        first = config.episodes - config.test_episodes
        seen = range(first, first + episodes)
        return tuple(EpisodePlan(f"{split}-{i:06d}", i, task_of(config, i), CHANGES[split]) for i in seen)
    tasks, new = config.held_out_tasks, range(config.episodes, config.episodes + episodes)
    return tuple(EpisodePlan(f"{split}-{i:06d}", i, tasks[i % len(tasks)]) for i in new)


def _held_out(config: SimConfig) -> dict[str, Any]:
    """Returns what is unseen in each split, JSON-ready."""
    what: dict[str, dict[str, Any]] = {
        "unseen_task": {"tasks": list(config.held_out_tasks)},
        "unseen_camera": {"yaw_degrees_to_either_side": list(YAW), "pitch_degrees": list(PITCH)},
        "unseen_color": {"turn_of_hue": list(TURN)},
    }
    return {split: what[split] for split in unseen_splits(config)}
