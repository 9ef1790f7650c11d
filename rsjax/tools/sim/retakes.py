"""Collects second takes of simulated clips: each starts like its clip and repeats the actions with slight jitter.

Physics-IQ's score asks a model to come as close to a clip as its second take does, and no closer.
"""

from collections.abc import Sequence

import numpy as np

from rsjax.config import SimConfig, content_key, from_dict
from rsjax.data.codec import Record
from rsjax.data.store import Store, open_store
from rsjax.errors import UserError
from rsjax.tools.sim.collect import Collection, Report, make_store
from rsjax.tools.sim.episode import EpisodePlan, Replay, begins_episode, source_name
from rsjax.tools.sim.unseen import UNITS

FOLDER = "retakes"  # inside the store's directory, so that it moves with the store
JITTER = 0.05  # standard deviation of the noise added to each number of an action, which lies in [-1, 1]
RECIPE = 1  # raise when the same clips give different second takes
MAX_START = 2.0  # grey levels: largest mean difference of frame 0; two OpenGL libraries differ by less


def collect_retakes(clips: Store, split: str, numbers: Sequence[int], workers: int, report: Report) -> list[Record]:
    """Collects a second take of each of these clips, unless it exists, and returns the takes in the clips' order.

    Args:
        clips: a store of simulated clips; the takes are stored in its directory.
        numbers: indices of the clips in the split.
        workers: processes that simulate; 0: one per core.
        report: called as episodes finish.

    Raises:
        UserError: the clips were not simulated, the simulator fails on one, or a take starts differently from its clip;
            also the errors of :func:`rsjax.tools.sim.collect.collect`.
    """
    saved = clips.manifest.get("config")
    config = None
    if isinstance(saved, dict) and "control_steps" in saved and "episodes" in saved:
        config = from_dict(SimConfig, saved)
    if config is None or source_name(config) != clips.manifest.get("source"):
        raise UserError(f"{clips.path}: these clips were not simulated, so there is no second take of them")
    records = [clips.source(split)[number] for number in numbers]
    if not all(map(begins_episode, records)):
        raise UserError(
            f"{clips.path}, split {split}: some of its clips begin in the middle of an episode, where the simulator "
            f"cannot begin; score without second takes"
        )
    plans = tuple(_plan(config, f"{split}-{place:06d}", record) for place, record in enumerate(records))
    key = content_key("second takes", RECIPE, str(clips.manifest.get("key")), split, tuple(map(int, numbers)), JITTER)
    meta = {name: clips.manifest[name] for name in UNITS} | {
        "retakes": {"of": clips.manifest.get("key"), "split": split, "jitter": JITTER}
    }
    out = clips.path / FOLDER / key
    make_store(Collection(key, config, {split: plans}, meta), out, report, workers)
    made = open_store(out).source(split)
    takes = {_identity(take): take for take in map(made.__getitem__, range(len(made)))}
    where = f"{clips.path}, split {split}"
    for record in records:
        episode = record["provenance"]["episode"]
        take = takes.get(_identity(record))
        if take is None:
            raise UserError(
                f"{where}: the simulator failed at the second take of episode {episode}; score without them"
            )
        apart = np.abs(take["rgb"][0].astype(np.float32) - record["rgb"][0]).mean()
        if apart > MAX_START:
            raise UserError(
                f"{where}: the second take of episode {episode} starts otherwise than the clip ({apart:.1f} of 255 "
                f"levels apart), so another version of the simulator made it; score without second takes, or simulate "
                f"anew"
            )
    return [takes[_identity(record)] for record in records]


def _identity(record: Record) -> tuple[int, str]:
    """Returns what tells a clip from the others of its split; paired clips have one episode's number."""
    origin = record["provenance"]
    return origin["episode"], str(origin["expert"])


def _plan(config: SimConfig, name: str, record: Record) -> EpisodePlan:
    """Returns the plan of a clip's second take, with the same change of appearance if the clip has one."""
    origin = record["provenance"]
    if config.env == "lift":
        task = ""
    else:
        task = record["task"]
    change = origin.get("unseen", {}).get("what")
    replay = Replay(record["actions"], JITTER, origin["expert"])
    return EpisodePlan(name, origin["episode"], task, change, replay, seed=origin["seed"])
