"""Records in batches, read with Grain: an endless seeded order that resumes exactly, or one pass in order.

A transform turns one record into arrays that stack: ``transform(record, rng) -> dict of arrays``. Its generator depends
only on the loader's seed and the record's place in the order, so random draws resume too. With worker processes it has
to be picklable: a module's function or a ``functools.partial`` of one.
"""

import logging
from collections.abc import Callable, Iterator
from typing import Any, Protocol, Self

import absl.flags
import grain
import numpy as np
from grain.experimental import ElasticIterator

from rsjax.data.store import Record, StoreError

MAX_DAMAGED = 0.01  # share of the records that training goes on without

Arrays = dict[str, np.ndarray]
Transform = Callable[[Record, np.random.Generator], Arrays]

_log = logging.getLogger(__name__)


class RecordSource(Protocol):
    """Random access to records, such as :class:`rsjax.data.store.Source`."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Record: ...


class Substituting:
    """A source that gives the next readable record in place of a damaged one, and logs each once.

    Args:
        source: what is read.

    Raises:
        StoreError: on reading, when more than ``MAX_DAMAGED`` of the records (and more than one) have been damaged.
    """

    def __init__(self, source: RecordSource) -> None:
        self._source = source
        self._most = max(1, int(MAX_DAMAGED * len(source)))
        self._damaged: set[int] = set()  # those that this process met

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, index: int) -> Record:
        while True:
            try:
                return self._source[index]
            except StoreError as error:
                self._note(index, error)
                index = (index + 1) % len(self)

    def _note(self, index: int, error: StoreError) -> None:
        new = index not in self._damaged
        self._damaged.add(index)
        count = f"{len(self._damaged)} of {len(self)} records are damaged"
        if len(self._damaged) > self._most:
            raise StoreError(f"{error} ({count}; training goes on without at most {self._most})") from error
        if new:
            _log.warning("%s; the next record is used instead (%s)", error, count)


class Loader:
    """An endless iterator of batches. Made by :func:`batches`; close it, or use it as a context manager."""

    def __init__(self, iterator: ElasticIterator) -> None:
        self._iterator = iterator

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Arrays:
        return next(self._iterator)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def state(self) -> dict[str, Any]:
        """Where the order stands, JSON-ready: :func:`batches` given this goes on with the batch that would be next."""
        return self._iterator.get_state()

    def close(self) -> None:
        """Stop the worker processes."""
        self._iterator.close()


def batches(
    source: RecordSource,
    transform: Transform,
    batch_size: int,
    seed: int,
    *,
    workers: int = 0,
    state: dict[str, Any] | None = None,
) -> Loader:
    """An endless loader: every epoch shuffled anew, batches across the epochs' borders, the same for any ``workers``.

    Args:
        source: the records; a damaged one is replaced as :class:`Substituting` says.
        transform: record → arrays, see above.
        batch_size: records per batch, over all processes of a multi-host run.
        seed: of the order and of the transform's generator.
        workers: processes that read and transform; 0 uses threads of this one.
        state: an earlier loader's :meth:`Loader.state`.

    Raises:
        StoreError: if the source is empty.
    """
    if not len(source):
        raise StoreError("the split has no records; collect or tokenize again")
    dataset = grain.MapDataset.source(Substituting(source)).seed(seed).shuffle().repeat(None)
    dataset = dataset.random_map(transform)
    if workers:
        absl.flags.FLAGS.mark_as_parsed()  # Grain's workers refuse to start otherwise
    iterator = ElasticIterator(
        dataset,
        batch_size,
        grain.sharding.ShardByJaxProcess(),
        read_options=grain.ReadOptions(num_threads=2, prefetch_buffer_size=4),  # in batches
        multiprocessing_options=grain.MultiprocessingOptions(num_workers=workers) if workers else None,
    )
    if state is not None:
        iterator.set_state(state)
    return Loader(iterator)


def epoch(source: RecordSource, batch_size: int, transform: Transform) -> Iterator[Arrays]:
    """One pass in order, for evaluation. A damaged record is an error here.

    Each batch also has ``weight``, float32 of shape (batch_size,): 1, but 0 where the last batch is filled up by
    repeating its last record.
    """
    for start in range(0, len(source), batch_size):
        indices = np.arange(start, start + batch_size)
        rows = [
            transform(source[int(index)], np.random.default_rng(int(index))) for index in indices[indices < len(source)]
        ]
        rows += [rows[-1]] * (batch_size - len(rows))
        batch = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        yield batch | {"weight": (indices < len(source)).astype(np.float32)}
