"""What the stages ``depth`` and ``tracks`` left of an episode, read again for the frames that are asked for."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float32, Int

from rsjax.data.codec import Record
from rsjax.data.store import Source
from rsjax.ingest.annotators.protocols import Tracked
from rsjax.ingest.episode import Episode, EpisodeError


class StoredDepths:
    """The depth stage's maps, as :class:`rsjax.ingest.episode.Depths`.

    Args:
        records: at least one; their fields are those that :mod:`rsjax.ingest.clips` names.
        episode: whose they are.

    Attributes:
        unit: "metres" or "relative" (see :mod:`rsjax.ingest.annotators.depth`).
    """

    def __init__(self, records: Source, episode: Episode) -> None:
        self._parts, self._episode = _Parts(records, lambda record: len(record["depth"])), episode
        self.unit = str(self._parts.record["unit"])

    def __len__(self) -> int:
        return len(self._episode.timestamps)

    def read(self, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
        """Raises :class:`EpisodeError` where a frame has no map."""
        return np.stack([self._map(int(index)) for index in indices])

    def _map(self, frame: int) -> Float32[np.ndarray, "H W"]:
        record = self._parts.holding(frame, frame)
        if record is None:
            raise EpisodeError(f"depth: no map of frame {frame} of episode {self._episode.id}; annotate it again")
        return record["depth"][frame - int(record["first"])].astype(np.float32)


class StoredTracks:
    """The tracks stage's points.

    Args:
        records: as those of :class:`StoredDepths`; none, where nothing was tracked.
    """

    def __init__(self, records: Source) -> None:
        self._parts = _Parts(records, lambda record: record["points"].shape[1]) if len(records) else None

    def at(self, frames: Int[np.ndarray, " T"]) -> Tracked | None:
        """The points of the shot that holds these frames, which increase, in these alone; None where none holds all."""
        record = self._parts.holding(int(frames[0]), int(frames[-1])) if self._parts else None
        if record is None:
            return None
        places = frames - int(record["first"])
        return Tracked(record["points"][:, places].astype(np.float32), record["visible"][:, places])


class _Parts:
    """Records of the frames from each one's ``first`` on. The last that was read is kept: windows come in order."""

    def __init__(self, records: Source, length: Callable[[Record], int]) -> None:
        self._records, self._length = records, length
        self._number, self.record = 0, records[0]

    def holding(self, first: int, last: int) -> Record | None:
        """The record of these frames and all between."""
        for number in [*range(self._number, len(self._records)), *range(self._number)]:
            if number != self._number:
                self._number, self.record = number, self._records[number]
            start = int(self.record["first"])
            if start <= first and last < start + self._length(self.record):
                return self.record
        return None
