"""The order of the records: stages one after another, each a mixture of parts, each part shuffled anew every epoch.

A transform turns one record into arrays that stack: ``transform(record, rng) -> dict of arrays``. Its generator depends
only on the loader's seed and the record's place in the order, so random draws resume too. With worker processes it has
to be picklable: a module's function or a ``functools.partial`` of one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import grain
import numpy as np
from jaxtyping import Int

from rsjax.data.codec import Record
from rsjax.data.quarantine import Quarantine
from rsjax.data.records import Readable, RecordSource

Arrays = dict[str, np.ndarray]
Transform = Callable[[Record, np.random.Generator], Arrays]


@dataclass(frozen=True)
class MixtureComponent:
    """Records of one source that a stage draws from.

    Attributes:
        source: what is read.
        transform: record → arrays, see above.
        chosen: the numbers of the records that count, in order; None: all.
        weight: share of the stage's records, relative to its other parts'.
    """

    source: RecordSource
    transform: Transform
    chosen: Int[np.ndarray, " N"] | None = None
    weight: float = 1.0

    def __len__(self) -> int:
        return len(self.source) if self.chosen is None else len(self.chosen)


@dataclass(frozen=True)
class CurriculumStage:
    """Parts that are mixed, and for how many records. How many does not matter in the last stage: it is endless."""

    parts: tuple[MixtureComponent, ...]
    records: int


def ordered(stages: Sequence[CurriculumStage], seed: int, quarantine: Quarantine) -> grain.MapDataset:
    """The records of all stages, one after another; each part shuffled anew in every epoch of its own.

    ``part`` counts the parts of all stages, in order.
    """
    mixed, number = [], 0
    for place, stage in enumerate(stages):
        datasets = []
        for part in stage.parts:
            datasets.append(_dataset(part, number, _seed(seed, number), quarantine))
            number += 1
        # Grain rounds weights to percents of the smallest one.
        weights = [part.weight for part in stage.parts]
        dataset = grain.MapDataset.mix(datasets, weights) if len(datasets) > 1 else datasets[0]
        mixed.append(dataset if place == len(stages) - 1 else dataset[: stage.records])
    before = sum(stage.records for stage in stages[:-1])
    if before:
        mixed[-1] = mixed[-1][: len(mixed[-1]) - before - 1]  # endless ones cannot be appended; this is long enough
    return grain.MapDataset.concatenate(mixed) if before else mixed[0]


def _dataset(part: MixtureComponent, number: int, seed: int, quarantine: Quarantine) -> grain.MapDataset:
    source = Readable(part.source, quarantine, part.chosen)
    dataset = grain.MapDataset.source(source).seed(seed).shuffle().repeat(None)
    return dataset.random_map(_Numbered(part.transform, number))


def _seed(seed: int, part: int) -> int:
    """The first part's is the seed itself, so that one part alone is the loader without stages."""
    return int(np.random.SeedSequence((seed, part)).generate_state(1)[0]) if part else seed


@dataclass(frozen=True)
class _Numbered:
    """A transform of (number, record) that keeps the number."""

    transform: Transform
    part: int

    def __call__(self, numbered: tuple[int, Record], rng: np.random.Generator) -> Arrays:
        number, record = numbered
        return self.transform(record, rng) | {"part": np.array(self.part, np.int32), "record": np.array(number)}
