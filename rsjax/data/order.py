"""The order of the records in training: stages of a curriculum, each a mixture of shuffled components.

A transform turns one record into arrays that stack: ``transform(record, rng) -> dict of arrays``. Its generator depends
only on the loader's seed and the record's place in the order, so random draws resume too. With worker processes a
transform has to be picklable: a function of a module, or a ``functools.partial`` of one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import grain
import numpy as np
from jaxtyping import Int

from rsjax.data.codec import Record
from rsjax.data.quarantine import Quarantine
from rsjax.data.store import RecordSource, Source, StoreError

Arrays = dict[str, np.ndarray]
Transform = Callable[[Record, np.random.Generator], Arrays]


@dataclass(frozen=True)
class MixtureComponent:
    """Records of one source that a stage draws from.

    Attributes:
        source: the source.
        transform: record → arrays, see above.
        chosen: numbers of the component's records, in order; None: all records of the source.
        weight: share of the stage's records, relative to the weights of its other components.
    """

    source: RecordSource
    transform: Transform
    chosen: Int[np.ndarray, " N"] | None = None
    weight: float = 1.0

    def __len__(self) -> int:
        return len(self.source) if self.chosen is None else len(self.chosen)


@dataclass(frozen=True)
class CurriculumStage:
    """A mixture of components, and its number of records; the last stage is endless, so that its number is ignored."""

    components: tuple[MixtureComponent, ...]
    records: int


class Readable:
    """Gives (number, record) for each record of a component; a damaged record is replaced by the next readable one.

    Raises:
        StoreError: on reading, if the quarantine has too many records or no record can be read.
    """

    def __init__(self, component: MixtureComponent, quarantine: Quarantine) -> None:
        self._component = component
        self._quarantine = quarantine

    def __len__(self) -> int:
        return len(self._component)

    def __getitem__(self, index: int) -> tuple[int, Record]:
        source = self._component.source
        chosen = self._component.chosen
        for place in range(index, index + len(self)):
            number = place % len(self) if chosen is None else int(chosen[place % len(self)])
            try:
                return number, source[number]
            except StoreError as error:
                self._quarantine.note(place_of(source, number), error)
                last = error
        raise last


def place_of(source: RecordSource, record: int) -> dict[str, Any]:
    """Returns where a record is, JSON-ready; only its number if the source is not a store's."""
    return source.locate(record) if isinstance(source, Source) else {"record": int(record)}


def ordered(stages: Sequence[CurriculumStage], seed: int, quarantine: Quarantine) -> grain.MapDataset:
    """Returns the records of all stages, one after another; each component is shuffled anew in each of its epochs.

    The arrays are the transform's, ``record`` (the record's number in its source) and ``part`` (the component's number,
    counted over all stages).
    """
    mixed = []
    number = 0
    for place, stage in enumerate(stages):
        datasets = []
        for component in stage.components:
            # The first component keeps the seed itself, so that alone it has the order of a loader without stages.
            own_seed = int(np.random.SeedSequence((seed, number)).generate_state(1)[0]) if number else seed
            records = grain.MapDataset.source(Readable(component, quarantine)).seed(own_seed).shuffle().repeat(None)
            datasets.append(records.random_map(partial(_transform, component.transform, number)))
            number += 1
        # Grain rounds weights to hundredths of the smallest one.
        weights = [component.weight for component in stage.components]
        dataset = grain.MapDataset.mix(datasets, weights) if len(datasets) > 1 else datasets[0]
        mixed.append(dataset if place == len(stages) - 1 else dataset[: stage.records])
    before = sum(stage.records for stage in stages[:-1])
    if before:
        mixed[-1] = mixed[-1][: len(mixed[-1]) - before - 1]  # endless data cannot be appended; this is long enough
    return grain.MapDataset.concatenate(mixed) if before else mixed[0]


def _transform(transform: Transform, part: int, numbered: tuple[int, Record], rng: np.random.Generator) -> Arrays:
    number, record = numbered
    return transform(record, rng) | {"part": np.array(part, np.int32), "record": np.array(number)}
