"""Reads batches of records with Grain, in an endless seeded order that resumes exactly, and puts them on the device.

The order has stages (of a curriculum), each a mixture of shuffled components. A transform turns one record into arrays
that stack: ``transform(record, rng) -> dict of arrays``. Its generator depends only on the loader's seed and the
record's place in the order, so random draws resume too. With worker processes a transform has to be picklable: a
function of a module, or a ``functools.partial`` of one.

A batch has the transform's arrays, stacked, and three more of shape (batch,): ``part`` int32 and ``record`` int64, by
which :meth:`Loader.identify` finds its clips, and ``index`` int32, the place in the batch over all processes of a
multi-host run.
"""

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import absl.flags
import grain
import numpy as np
from grain.experimental import ThreadPrefetchDatasetIterator
from jaxtyping import Int

from rsjax.config import ConfigError
from rsjax.data.codec import Record
from rsjax.data.quarantine import MAX_DAMAGED, Quarantine
from rsjax.data.store import RecordSource, Source, StoreError

Arrays = dict[str, np.ndarray]
Transform = Callable[[Record, np.random.Generator], Arrays]

MAX_RESTARTS = 3  # in a row, after worker processes that die before they give a batch
PLACE = "global_next_index"  # the key in the state of Grain's ElasticIterator

_log = logging.getLogger(__name__)


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


class Loader:
    """An endless iterator over the batches of a curriculum. Close it, or use it as a context manager.

    The order of the batches is the same for any number of processes and workers; a batch may span two epochs.
    Grain's ``ElasticIterator`` shards and batches in the same way, but it cannot run a function in starting workers.

    Args:
        stages: stages of the curriculum, one after another; the last stage is endless.
        batch_size: records per batch, over all processes of a multi-host run.
        seed: seed of the order and of the transforms' generators.
        quarantine: the list of damaged records, which are replaced as in :class:`Readable`.
        workers: processes that read and transform; 0: threads of this process.
        state: :meth:`state` of an earlier loader.
        shard: the share of each batch that this process gets; None: by its index among jax's processes.

    Raises:
        StoreError: a component has no records.
        ConfigError: the batch size is not a multiple of the number of processes.
    """

    def __init__(
        self,
        stages: Sequence[CurriculumStage],
        batch_size: int,
        seed: int,
        quarantine: Quarantine,
        *,
        workers: int = 0,
        state: dict[str, Any] | None = None,
        shard: grain.sharding.ShardOptions | None = None,
    ) -> None:
        self._components = [component for stage in stages for component in stage.components]
        if not all(map(len, self._components)):
            raise StoreError("the split has no records; collect or tokenize again")
        self._shard = shard or grain.sharding.ShardByJaxProcess()
        if batch_size % self._shard.shard_count:
            count = self._shard.shard_count
            raise ConfigError(f"batch_size {batch_size} does not divide over {count} processes; make it a multiple")
        self._dataset = ordered(stages, seed, quarantine)
        self._stages = stages
        self._batch_size = batch_size
        self._seed = seed
        self._quarantine = quarantine
        self._workers = workers
        self._place = 0 if state is None else int(state[PLACE])
        self._iterator: Any = None
        self._restarts = 0

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Arrays:
        while True:
            if self._iterator is None:
                self._iterator = iter(self._cut())
            try:
                arrays = next(self._iterator)
                break
            except RuntimeError as error:  # from Grain: a worker was killed, usually for lack of memory
                if not self._workers or "terminated unexpectedly" not in str(error):
                    raise
                self.close()
                self._restarts += 1
                if self._restarts > MAX_RESTARTS:
                    raise StoreError(
                        f"processes that read data died {self._restarts} times in a row, the last with: {error}; "
                        f"run again with fewer workers (now {self._workers})"
                    ) from error
                _log.warning("a process that reads data died (%s); it is started again", error)
        self._restarts = 0
        self._place += self._batch_size
        local = np.arange(self._batch_size // self._shard.shard_count, dtype=np.int32)
        return arrays | {"index": self._shard.shard_index + self._shard.shard_count * local}

    def _cut(self) -> grain.IterDataset:
        shard = self._shard
        cut = self._dataset[self._place + shard.shard_index :: shard.shard_count]
        cut = cut.batch(self._batch_size // shard.shard_count, drop_remainder=True)
        cut = cut.to_iter_dataset(grain.ReadOptions(num_threads=2, prefetch_buffer_size=4))  # the buffer counts batches
        if not self._workers:
            return cut
        absl.flags.FLAGS.mark_as_parsed()  # Grain's workers refuse to start otherwise
        return cut.mp_prefetch(grain.MultiprocessingOptions(self._workers, per_worker_buffer_size=2), _start_worker)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def state(self) -> dict[str, Any]:
        """Returns the place in the order, JSON-ready, from which :func:`batches` resumes with the next batch."""
        return {PLACE: self._place}

    def identify(self, arrays: Arrays) -> list[dict[str, Any]]:
        """Returns where the records of a batch are and where they come from, one JSON-ready object per row.

        ``store``, ``split``, ``record`` and ``file`` say where a record is (only ``record`` if its source is no
        store's); ``task`` and ``provenance`` are the record's own, if it has them and can still be read.
        """
        rows = []
        for part, number in zip(arrays["part"], arrays["record"], strict=True):
            source = self._components[part].source
            rows.append(place_of(source, int(number)))
            with contextlib.suppress(StoreError):
                record = source[int(number)]
                rows[-1] |= {name: record[name] for name in ("task", "provenance") if name in record}
        return rows

    def whole(self, state: dict[str, Any]) -> "Loader":
        """Returns a loader that starts at this state and reads the rows of all processes, to look at a batch again."""
        shard = grain.sharding.NoSharding()
        return Loader(self._stages, self._batch_size, self._seed, self._quarantine, state=state, shard=shard)

    @property
    def shared(self) -> bool:
        """Returns whether other processes get the rest of each batch."""
        return self._shard.shard_count > 1

    def quarantined(self) -> int:
        """Returns how many damaged records all processes have found, also in earlier runs of this stage."""
        return self._quarantine.count()

    def close(self) -> None:
        """Stops the worker processes; the next batch starts new ones."""
        if self._iterator is not None:
            self._iterator.close()
            self._iterator = None


def batches(
    source: RecordSource,
    transform: Transform,
    batch_size: int,
    seed: int,
    *,
    quarantine: Path | None = None,
    max_damaged: float = MAX_DAMAGED,
    **options: Any,
) -> Loader:
    """Returns a loader of one source, without stages, which shuffles anew in every epoch.

    Args:
        transform: record → arrays, see the head of this module.
        quarantine: the file that lists damaged records; None: no file is written.
        max_damaged: share of the records that may be damaged.
        options: ``workers``, ``state`` and ``shard`` of :class:`Loader`.
    """
    stages = [CurriculumStage((MixtureComponent(source, transform),), 0)]
    return Loader(stages, batch_size, seed, Quarantine(quarantine, len(source), max_damaged), **options)


def _start_worker(index: int, count: int) -> None:
    """Prepares a worker process, which leaves signals to its parent and does not outlive the parent."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def die_with_parent() -> None:
        parent.join()
        os._exit(1)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=die_with_parent, daemon=True).start()


class DeviceBatch(NamedTuple):
    """One batch on the device.

    Attributes:
        batch: the input of the training step.
        clips: ``part`` and ``record`` of this process's rows, which :meth:`Prefetch.identify` reads.
        before: state of a loader whose next batch is this one.
        after: state of a loader whose next batch is the following one.
    """

    batch: Any
    clips: Arrays
    before: dict[str, Any]
    after: dict[str, Any]


class Prefetch:
    """An iterator over a loader's batches, which a thread of Grain makes in advance and puts onto the device.

    If the loader, ``to_batch`` or ``put`` fails, the call for that batch raises the error, and so does each later call.
    Close the iterator, or use it as a context manager; this closes the loader too.

    Args:
        loader: source of the batches; nothing else may read it from now on.
        to_batch: turns a loader's arrays into the input of the training step.
        put: puts that input on the device.
        ahead: how many finished batches wait on the device, at most.

    Attributes:
        waited: total seconds that calls for the next batch have taken.
    """

    def __init__(
        self, loader: Loader, to_batch: Callable[[Arrays], Any], put: Callable[[Any], Any], ahead: int = 2
    ) -> None:
        self._loader = loader
        self._state = loader.state()
        self._batches: Any = ThreadPrefetchDatasetIterator(_Batches(loader, to_batch, put), ahead)
        self._batches.start_prefetch()
        self.waited = 0.0

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> DeviceBatch:
        began = time.monotonic()
        item = next(self._batches)
        self.waited += time.monotonic() - began
        if isinstance(item, BaseException):
            raise item
        self._state = item.after
        return item

    def state(self) -> dict[str, Any]:
        """Returns the loader's state after the last batch that was handed out, however many were made in advance."""
        return self._state

    def identify(self, batch: DeviceBatch) -> list[dict[str, Any]]:
        """Returns where the clips of a batch are and come from, as :meth:`rsjax.data.loader.Loader.identify` does.

        If several processes share the batch, it is read once more to identify the rows of all processes.
        """
        if not self._loader.shared:
            return self._loader.identify(batch.clips)
        with self._loader.whole(batch.before) as whole:
            return whole.identify(next(whole))

    def quarantined(self) -> int:
        """Returns how many records are known to be damaged."""
        return self._loader.quarantined()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stops the thread and closes the loader."""
        if self._batches is not None:
            self._batches.close()
            self._batches = None  # Grain's iterator prints an error if it still exists at the interpreter's exit
        self._loader.close()


class _Batches:
    """A loader's batches on the device, in the form that Grain prefetches from.

    After an error, each further item is that error. Grain's thread forwards only an :class:`Exception`; any other
    error, such as :class:`rsjax.errors.Preempted`, ends it silently, and the training loop would wait for ever.
    """

    def __init__(self, loader: Loader, to_batch: Callable[[Arrays], Any], put: Callable[[Any], Any]) -> None:
        self._loader = loader
        self._to_batch = to_batch
        self._put = put
        self._failure: BaseException | None = None

    def __iter__(self) -> Iterator[DeviceBatch | BaseException]:
        return self

    def __next__(self) -> DeviceBatch | BaseException:
        if self._failure is not None:
            return self._failure
        try:
            before = self._loader.state()
            arrays = next(self._loader)
            clips = {name: arrays[name] for name in ("part", "record")}
            return DeviceBatch(self._put(self._to_batch(arrays)), clips, before, self._loader.state())
        except BaseException as error:
            self._failure = error
            return error

    def get_state(self) -> dict[str, Any]:
        return self._loader.state()
