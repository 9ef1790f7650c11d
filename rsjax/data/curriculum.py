"""Which records a training loop reads, in which stages: the config's patterns, resolved against stores."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.config import LoopConfig, PartConfig, StageConfig
from rsjax.config.stages import format_stage
from rsjax.data.labels import Labels
from rsjax.data.loader import Loader, staged_batches
from rsjax.data.order import Arrays, CurriculumStage, MixtureComponent, Transform
from rsjax.data.quarantine import NAME, Quarantine
from rsjax.data.records import Readable, place_of
from rsjax.data.store import Store, StoreError, open_store

LABELS = ("task", "difficulty")
EVERYTHING = StageConfig()


class CurriculumError(StoreError):
    """Stages that do not fit the data. The message names the part and what there is."""


@dataclass(frozen=True)
class LoaderFactory:
    """Makes a training loop's loaders: ``feed(state)`` goes on from an earlier one's state, None begins.

    Attributes:
        loop: the loop with ``steps`` and ``restarts`` as its stages make them.
        stages: the resolved ones.
        quarantine: the list of damaged records.
    """

    loop: LoopConfig
    stages: tuple[CurriculumStage, ...]
    quarantine: Path

    def __call__(self, state: dict[str, Any] | None) -> Loader:
        loop = self.loop
        listed = Quarantine(self.quarantine, _distinct(self.stages), loop.max_damaged)
        return staged_batches(self.stages, loop.batch_size, loop.seed, listed, workers=loop.workers, state=state)

    def replay(self, state: dict[str, Any]) -> Arrays:
        """The whole batch, over all processes, that a loader in this state gives next."""
        with self(None).whole(state) as loader:
            return next(loader)

    def summary(self) -> list[str]:
        """A line for each stage of the config: what it reads and for how many steps. None where there are no stages."""
        lines, first = [], 0
        for config, stage in zip(self.loop.stages, self.stages, strict=False):
            last = first + stage.records // self.loop.batch_size
            clips = " + ".join(str(len(part)) for part in stage.parts)
            lines.append(f"stage {format_stage(config)}: {clips} clips, steps {first + 1} to {last}")
            first = last
        return lines


def plan(
    loop: LoopConfig, own: Store, transform: Callable[[Store], Transform], directory: Path, split: str = "train"
) -> tuple[LoopConfig, LoaderFactory]:
    """Resolves a loop's stages: which records, how many steps.

    Args:
        loop: its ``stages``, or none: all of ``own``, for ``loop.steps`` steps.
        own: the store that parts without a store of their own read.
        transform: a store to the transform of its records; all have to give arrays of the same shapes.
        directory: where the list of damaged records is kept.
        split: of every store.

    Returns:
        The loop with ``steps`` (each stage's rounded up to whole batches) and ``restarts`` set, and what makes its
        loaders, for :func:`rsjax.training.loop.fit`.

    Raises:
        StoreError: a part's store cannot be read or does not go with ``own``, or nothing passes its patterns.
    """
    resolved = [_resolve(stage, loop.batch_size, own, transform, split) for stage in loop.stages or (EVERYTHING,)]
    if loop.stages:
        steps = [stage.records // loop.batch_size for stage in resolved]
        firsts = np.cumsum([0, *steps]).tolist()
        restarts = tuple(
            first for first, stage in zip(firsts, loop.stages, strict=False) if stage.restart and first > 0
        )
        loop = replace(loop, steps=firsts[-1], restarts=restarts)
    return loop, LoaderFactory(loop, tuple(resolved), directory / NAME)


def check_stages(loop: LoopConfig, own: Store, split: str = "train") -> None:
    """Looks ahead: a store that is not there, or patterns that let nothing through, as far as the stores are labelled.

    Raises:
        StoreError: as :func:`plan` would.
    """
    for part in (part for stage in loop.stages for part in stage.parts):
        store = open_store(part.store) if part.store else own
        if store.labelled(split):
            choose(part, store, split)


def choose(part: PartConfig, store: Store, split: str) -> np.ndarray | None:
    """The numbers of the records that pass the part's patterns; None where they let everything through.

    Raises:
        CurriculumError: none passes; the message lists what there is.
    """
    patterns = {"task": part.tasks, "difficulty": part.difficulties}
    if all("*" in allowed for allowed in patterns.values()):
        return None
    labels = store.labels(split)
    chosen = np.flatnonzero(labels.matching(patterns))
    if not len(chosen):
        raise CurriculumError(
            f"{store.path}: no {split} record has a difficulty like {' or '.join(part.difficulties)} and a task like "
            f"{' or '.join(part.tasks)}; it has {_listed(labels)}: change the stage's patterns"
        )
    return chosen


def _resolve(
    stage: StageConfig, batch_size: int, own: Store, transform: Callable[[Store], Transform], split: str
) -> CurriculumStage:
    parts = []
    for config in stage.parts:
        store = open_store(config.store) if config.store else own
        part = MixtureComponent(store.source(split), transform(store), choose(config, store, split), config.weight)
        if not len(part):
            raise StoreError(f"{store.path}: its {split} split has no records; make it again")
        if config.store:
            _check_kin(store, part, own, MixtureComponent(own.source(split), transform(own)))
        parts.append(part)
    drawn = stage.epochs * sum(map(len, parts))
    # Epochs such as 0.1 are not exact in binary: a hair above a whole number of batches is that number.
    batches = max(1, math.ceil(drawn / batch_size - 1e-6))
    return CurriculumStage(tuple(parts), batches * batch_size)


def _check_kin(store: Store, part: MixtureComponent, own: Store, own_part: MixtureComponent) -> None:
    """Raises :class:`CurriculumError` where batches cannot hold records of both stores."""
    for name in ("kind", "tokenizer"):
        there, here = store.manifest.get(name), own.manifest.get(name)
        if there != here:
            raise CurriculumError(
                f"{store.path}: its {name} is {there}, that of {own.path} is {here}; a mixture needs records of one "
                f"kind, made with the same tokenizer"
            )
    there, here = _shapes(part), _shapes(own_part)
    for name in there | here:
        if there.get(name) != here.get(name):
            raise CurriculumError(
                f"{store.path}: its {name} is {there.get(name)}, that of {own.path} is {here.get(name)}; a mixture "
                f"needs clips of one length and size"
            )


def _shapes(part: MixtureComponent) -> dict[str, str]:
    _, record = Readable(part.source, Quarantine(None, len(part.source), 1.0), part.chosen)[0]
    arrays = part.transform(record, np.random.default_rng(0))
    return {name: f"{array.dtype} {array.shape}" for name, array in arrays.items()}


def _listed(labels: Labels) -> str:
    counts = labels.counts()
    return "; ".join(
        f"{name} " + ", ".join(f"{word!r} {count}×" for word, count in sorted(counts[name].items())) for name in LABELS
    )


def _distinct(stages: tuple[CurriculumStage, ...]) -> int:
    """How many records there are in all, each counted once."""
    chosen: dict[str, list[np.ndarray]] = {}
    for part in (part for stage in stages for part in stage.parts):
        numbers = np.arange(len(part.source)) if part.chosen is None else part.chosen
        chosen.setdefault(place_of(part.source, 0)["store"], []).append(numbers)
    return sum(len(np.unique(np.concatenate(numbers))) for numbers in chosen.values())
