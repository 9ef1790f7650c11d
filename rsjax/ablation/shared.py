"""Work that cells have in common is done once and linked into each of them.

The clips lie outside the runs. A tokenizer, the tokens and, where cells only differ in how they are decoded or scored,
the world model are made under ``shared`` in a directory named by their content key, which is a run directory too. From
there, or from a cell that has them, they come into a cell as hard links, and tokens, which lie with the clips, as a
link to them: every cell is a whole run directory that can be moved, resumed or deleted by itself, at no cost of disk.
"""

import errno
import os
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rsjax.files import disk_guard, lock
from rsjax.pipeline import stages
from rsjax.pipeline.run import Run
from rsjax.progress import note

COMMON = ("tokenizer", "tokens")
TAKES_COPIES = (errno.EXDEV, errno.EPERM, errno.EOPNOTSUPP, errno.EMLINK)  # where hard links do not go


def share(run: Run, others: Sequence[Run], place: Path) -> None:
    """Gives a cell's run what it has in common with others, which is made now if no one has it yet.

    Any number of processes may do so at once; those that need the same wait for the one that makes it. Where that one
    is killed, the next goes on from its checkpoints.

    Args:
        others: the other cells' runs.
        place: where what is shared is made and kept.
    """
    # A store of the user's own is only looked at, and may lie where nothing can be written.
    locks = place / ".locks" if run.config.data.key else run.clips.parent
    with lock(locks / f".{run.clips.name}.lock", wait="waiting for another process that collects"):
        if not run.finished("collect"):
            with run.stage("collect"):
                stages.collect_clips(run)
    keys = run.keys()
    for stage in COMMON:
        _provide(run, others, stage, place)
    if any(other.keys()["world_model"] == keys["world_model"] for other in others):
        _provide(run, others, "world_model", place)


def _provide(run: Run, others: Sequence[Run], stage: str, place: Path) -> None:
    if run.finished(stage):
        return
    key = run.keys()[stage]
    room = Run(run.config, place / f"{stage}-{key}", run.data_directory)
    with lock(place / ".locks" / room.directory.name, wait=f"waiting for another process that makes the {stage}"):
        sources = [room, *(other for other in others if other.keys()[stage] == key)]
        source = next((source for source in sources if source.finished(stage)), None)
        if source is None:
            room.prepare(overwrite=False)
            for before in COMMON[: COMMON.index(stage)] if stage in COMMON else COMMON:
                link_stage(run, room, before)
            note(f"for all cells that share it, in {room.directory}: {stage.replace('_', ' ')}")
            with room.stage(stage):
                _make(room, stage)
            source = room
        link_stage(source, run, stage)


def _make(run: Run, stage: str) -> None:
    if stage == "tokenizer":
        stages.train_tokenizer(run, resume=True)
    elif stage == "tokens":
        stages.tokenize(run)
    else:
        stages.train_world_model(run, resume=True)


def link_stage(source: Run, run: Run, stage: str) -> None:
    """Puts a finished stage of one run into another; it appears there whole. Checkpoints, to resume from, stay behind.

    Only what the stage leaves is linked, since nothing ever changes it; logs and marks are copied.
    """
    if run.finished(stage):
        return
    target, building = run.directory / stage, run.directory / f"{stage}.linking"
    with disk_guard(building):
        shutil.rmtree(building, ignore_errors=True)
        left, place = shutil.ignore_patterns("checkpoints"), partial(_place, source.output(stage))
        shutil.copytree(source.directory / stage, building, symlinks=True, ignore=left, copy_function=place)
        shutil.rmtree(target, ignore_errors=True)
        building.rename(target)


def _place(output: Path, source: str, target: str) -> None:
    if output in Path(source).parents:
        try:
            os.link(source, target)
            return
        except OSError as error:
            if error.errno not in TAKES_COPIES:
                raise
    shutil.copy2(source, target)
