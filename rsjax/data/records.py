"""Where a loader's records come from: a source, or a part of one, in which damaged records are replaced."""

from typing import Any, Protocol

import numpy as np
from jaxtyping import Int

from rsjax.data.codec import Record
from rsjax.data.quarantine import Quarantine
from rsjax.data.store import Source, StoreError


class RecordSource(Protocol):
    """Random access to records, such as :class:`rsjax.data.store.Source`."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Record: ...


def place_of(source: RecordSource, record: int) -> dict[str, Any]:
    """Where a record lies, JSON-ready; of a source that is not a store's, its number alone."""
    return source.locate(record) if isinstance(source, Source) else {"record": int(record)}


class Readable:
    """(number, record) of a source's records, or of some; in place of a damaged one, the next that can be read.

    Args:
        source: what is read.
        quarantine: where damaged records are listed.
        chosen: the numbers of the records that count, in order; None: all.

    Raises:
        StoreError: on reading, when the quarantine has too many, or nothing can be read at all.
    """

    def __init__(
        self, source: RecordSource, quarantine: Quarantine, chosen: Int[np.ndarray, " N"] | None = None
    ) -> None:
        self._source, self._quarantine, self._chosen = source, quarantine, chosen

    def __len__(self) -> int:
        return len(self._source) if self._chosen is None else len(self._chosen)

    def __getitem__(self, index: int) -> tuple[int, Record]:
        for place in range(index, index + len(self)):
            number = place % len(self) if self._chosen is None else int(self._chosen[place % len(self)])
            try:
                return number, self._source[number]
            except StoreError as error:
                self._quarantine.note(place_of(self._source, number), error)
                last = error
        raise last
