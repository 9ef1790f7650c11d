"""Finds the clips that an evaluation scores: a run's own, longer episodes, unseen scenes, second takes, and probes."""

from collections.abc import Callable, Collection
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import TypeVar

import numpy as np

from rsjax.clip import Video
from rsjax.config import SimConfig, from_dict
from rsjax.config.sim import EXPERT
from rsjax.data.codec import Record
from rsjax.data.store import Store, StoreError, open_store
from rsjax.errors import UserError, first_line
from rsjax.evaluation.evaluate import EvaluationClips
from rsjax.evaluation.probes import Probes
from rsjax.evaluation.protocols import Protocol
from rsjax.evaluation.registry import Unavailable
from rsjax.progress import Progress, note
from rsjax.tools.pipeline.run import Run
from rsjax.tools.sim import retakes
from rsjax.tools.sim.collect import Report, collect, collection_key
from rsjax.tools.sim.contacts import collect_contacts, contact_splits
from rsjax.tools.sim.episode import source_name
from rsjax.tools.sim.probes import collect_probes
from rsjax.tools.sim.unseen import collect_unseen, unseen_splits
from rsjax.training.distributed import on_lead

LONGER_SEED = 1_000_000  # added to a run's seed, so that longer episodes differ from the run's own
LEAST_CLIPS = 48  # scored clips from which on grasps and drives are worth their time
LONGER_TRAIN = 2  # episodes in the train split of longer episodes, which nothing uses
T = TypeVar("T")


def chosen_splits(store: Store, wanted: tuple[str, ...]) -> list[str]:
    """Returns the store's splits with these names; a name that ends in ``*`` stands for all with that beginning."""
    if lacking := _lacking(store.splits, wanted):
        raise StoreError(
            f"{store.path}: no split {lacking[0]!r}; it has {', '.join(store.splits)}: choose with --split, or name "
            f"another store with --data"
        )
    return [split for split in store.splits if any(fnmatchcase(split, pattern) for pattern in wanted)]


def _lacking(splits: Collection[str], wanted: tuple[str, ...]) -> list[str]:
    """Returns the wanted names or patterns that match no split."""
    return [pattern for pattern in wanted if not any(fnmatchcase(split, pattern) for split in splits)]


def evaluation_store(run: Run, store: Store, protocol: Protocol) -> Store:
    """Returns the run's store, or one of longer episodes, unseen scenes or contacts, simulated if necessary.

    With the few clips of a saved model, nothing is simulated.
    """
    sim = run.config.sim
    workers = run.config.runtime.workers
    needed = protocol.prompt_frames + protocol.horizon
    if run.config.data is not None or "train" not in store.splits:
        return store
    known = not _lacking(store.splits, protocol.splits)
    count = min(protocol.clips, sim.test_episodes)
    if not known and not _lacking(unseen_splits(sim), protocol.splits):
        return _simulated(
            f"scenes never seen, {count} episodes of each kind",
            lambda report: collect_unseen(sim, store, count, report, workers),
        )
    if not known and not _lacking(contact_splits(sim), protocol.splits):
        return _simulated(
            f"contacts, {count} episodes of each kind",
            lambda report: collect_contacts(sim, store, count, report, workers),
        )
    if needed <= sim.frames or not known or chosen_splits(store, protocol.splits) != ["test"]:
        return store
    longer = longer_episodes(sim, needed, protocol.clips)
    path = run.data_directory / f"{sim.env}-{collection_key(longer)}"

    def make(report: Report) -> Store:
        collect(longer, path, report, workers)
        return open_store(path)

    return _simulated(f"{protocol.clips} episodes of {needed} frames; the run's have {sim.frames}", make)


def with_retakes(eval_clips: EvaluationClips, workers: int) -> EvaluationClips:
    """Adds second takes of all clips, which are simulated if necessary."""
    protocol = eval_clips.protocol
    clips = eval_clips.clips
    if protocol.reference != "recorded":
        raise UserError(f"protocol {protocol.name} compares with reconstructions, of which there is no second take")

    def make(report: Report) -> list[Record]:
        return retakes.collect_retakes(eval_clips.store, eval_clips.split, clips.index.tolist(), workers, report)

    takes = _simulated(f"second takes of {len(clips.rgb)} clips", make)
    return replace(eval_clips, retakes=Video(np.stack([take["rgb"][: clips.rgb.shape[1]] for take in takes])))


def probes_of(run: Run, store: Store, eval_clips: EvaluationClips) -> Probes | Unavailable:
    """Returns grasps and drives in the simulator of a run's clips, or why the evaluation has none.

    They are simulated unless they exist. Only the lead process calls this.

    Args:
        store: the run's clips, beside which the probes are kept.
    """
    protocol = eval_clips.protocol
    source = store.manifest.get("source")
    if not run.config.model.takes_actions:
        return Unavailable("the model takes no actions")
    if "train" not in store.splits:
        return Unavailable("there are no training clips, from which a network learns to read grasps and drives")
    if source != source_name(SimConfig()):
        return Unavailable(f"grasps and drives are simulated in Lift alone; the clips are of {source or 'recordings'}")
    if eval_clips.split != "test":
        return Unavailable(f"grasps and drives are scored with the split test, not with {eval_clips.split}")
    if protocol.teacher_forced:
        return Unavailable(f"protocol {protocol.name} gives the true frames before each predicted one")
    if len(eval_clips.records) < LEAST_CLIPS:
        count = len(eval_clips.records)
        return Unavailable(f"{count} clips are scored; grasps and drives are simulated where {LEAST_CLIPS} or more are")
    config = from_dict(SimConfig, store.manifest["config"])
    with Progress("simulating grasps and drives", 0, "episodes") as progress:
        try:
            return collect_probes(config, store, _report_to(progress), run.config.runtime.workers)
        except UserError as error:  # such as a machine without OpenGL; the other metrics do not need it
            note(f"no grasps and drives: {first_line(error)}")
            return Unavailable(first_line(error))


def _simulated(what: str, make: Callable[[Report], T]) -> T:
    """Returns clips that the lead process makes unless they exist; the other processes then find them."""
    with Progress(f"simulating {what}", 0, "episodes") as progress:
        on_lead("simulation", make, _report_to(progress))
        return make(_report_to(progress))


def _report_to(progress: Progress) -> Report:
    def report(done: int, total: int) -> None:
        progress.total = total
        progress.update(done)

    return report


def longer_episodes(sim: SimConfig, frames: int, clips: int) -> SimConfig:
    """Returns the configuration of held-out episodes that are longer than a run's, with a seed other than the run's."""
    seed = (sim.seed + LONGER_SEED) % 2**32
    episodes = clips + LONGER_TRAIN
    return replace(sim, frames=frames, seed=seed, episodes=episodes, test_episodes=clips, recipe=(EXPERT,))
