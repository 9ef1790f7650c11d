"""One ``proprio_stats.h5`` of AgiBot-World: states, and commands made as long as they are.

Axes: N frames, M ≤ N commands, D dimensions.
"""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float32, Float64, Int64

from rsjax.ingest.actions import unflipped
from rsjax.ingest.episode import EpisodeError
from rsjax.ingest.formats.files import MAX_CELLS
from rsjax.ingest.formats.hdf5 import own

_CURE = "leave the episode out"
_STATES = (
    ("end/position", 6),
    ("end/orientation", 8),
    ("effector/position", 2),
    ("joint/position", 14),
    ("head/position", 2),
    ("waist/position", 2),
)


class Proprio:
    """The arrays of an open file, each flattened to (rows, D).

    Attributes:
        notes: what had to be mended, JSON-ready: fields that are empty, commands that were scattered, quaternions that
            changed sign.
    """

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._file, self._path = file, path
        stamps = self._rows("timestamp", 1)
        if not len(stamps):
            raise EpisodeError(f"{path}: timestamp is missing or empty; {_CURE}")
        self._count = len(stamps)
        self.notes: dict[str, Any] = {"empty": [], "scattered": {}, "flipped": {}}

    def seconds(self) -> Float64[np.ndarray, " N"]:
        """From the first frame; the file has nanoseconds."""
        stamps = self._rows("timestamp", 1)[:, 0]
        whole = stamps.astype(np.int64) if stamps.dtype.kind in "iu" else stamps  # unsigned ones wrap around
        return (whole - whole[0]).astype(np.float64) / 1e9

    def states(self) -> Float32[np.ndarray, "N 34"]:
        """Positions (6, m), orientations (8), grippers (2, mm), joints (14, rad), head (2, rad), waist (2, rad, m)."""
        parts = {name: self._state(name, width) for name, width in _STATES}
        parts["end/orientation"] = self.turns("state/end/orientation")
        with np.errstate(over="ignore"):  # what float32 cannot hold is infinite, which is told
            return np.concatenate(list(parts.values()), 1).astype(np.float32)

    def turns(self, name: str) -> Float64[np.ndarray, "N 8"]:
        """Both hands' quaternions, at every frame, each with continuous signs. Raises as :meth:`command`."""
        kind, _, field = name.partition("/")
        pair = self._state(field, 8) if kind == "state" else self.command(field)
        mended = np.concatenate([unflipped(pair[:, :4]), unflipped(pair[:, 4:])], 1)
        if rows := int((mended != pair).any(1).sum()):
            self.notes["flipped"][name] = rows
        return mended

    def command(self, name: str) -> Float64[np.ndarray, "N D"]:
        """``action/name`` at every frame; where none was sent, the state. Zeros where the field is empty.

        Raises:
            EpisodeError: there are more commands than frames, or it is not known at which frames they were sent.
        """
        width = dict(_STATES)[name]
        commands = self._commands(name, width)
        if not len(commands):
            return np.zeros((self._count, width))
        made = self._state(name, width)
        made[self._index(name, len(commands))] = commands
        return made

    def grippers(self) -> Float64[np.ndarray, "N 2"]:
        """``action/effector/position`` at every frame: the last one sent, before the first one 0 (open).

        The state cannot stand in, it is in millimetres; raises :class:`EpisodeError` as :meth:`command`.
        """
        commands = self._commands("effector/position", 2)
        made = np.zeros((self._count, 2))
        if len(commands):
            index = self._index("effector/position", len(commands))
            last = np.searchsorted(index, np.arange(self._count), side="right") - 1
            made[last >= 0] = commands[last[last >= 0]]
        return made

    def copied(self) -> bool:
        """Whether the hands' commands are the states at the same frames, and so say nothing of the next."""
        for name in ("end/position", "end/orientation"):
            commands = self._commands(name, dict(_STATES)[name])
            if not len(commands):
                return False
            index = self._index(name, len(commands))
            if not np.allclose(commands, self._state(name, commands.shape[1])[index], rtol=0, atol=1e-6):
                return False
        return True

    def _state(self, name: str, width: int) -> Float64[np.ndarray, "N D"]:
        rows = self._rows(f"state/{name}", width)
        if not len(rows):
            self._note_empty(f"state/{name}")
            return np.zeros((self._count, width))
        if len(rows) != self._count:
            raise EpisodeError(f"{self._path}: state/{name} has {len(rows)} rows, timestamp {self._count}; {_CURE}")
        return rows

    def _commands(self, name: str, width: int) -> Float64[np.ndarray, "M D"]:
        rows = self._rows(f"action/{name}", width)
        if not len(rows):
            self._note_empty(f"action/{name}")
        if len(rows) > self._count:
            raise EpisodeError(f"{self._path}: action/{name} has {len(rows)} rows, more than {self._count}; {_CURE}")
        return rows

    def _index(self, name: str, count: int) -> Int64[np.ndarray, " M"]:
        """The frames at which the commands of a field were sent."""
        if count == self._count:
            return np.arange(count)
        group = name.partition("/")[0]
        chosen = f"action/{group}/index"
        index = self._rows(chosen, 1)[:, 0]
        if not len(index):
            chosen = "action/joint/index"
            index = self._rows(chosen, 1)[:, 0]
        if len(index) != count:
            raise EpisodeError(f"{self._path}: action/{name} has {count} rows, {chosen} {len(index)}; {_CURE}")
        places = index.astype(np.int64)
        if (places != index).any() or places[0] < 0 or places[-1] >= self._count or (np.diff(places) <= 0).any():
            raise EpisodeError(f"{self._path}: {chosen} is not increasing within 0 … {self._count - 1}; {_CURE}")
        self.notes["scattered"][name] = count
        return places

    def _rows(self, name: str, width: int) -> np.ndarray:
        """A dataset as (rows, width), with no rows where it is missing or empty; float64, times as they are."""
        data = own(self._file, name, self._path)
        if not isinstance(data, h5py.Dataset) or not data.size:
            return np.zeros((0, width))
        if data.size > MAX_CELLS or data.dtype.kind not in "fiu" or not data.ndim:
            raise EpisodeError(f"{self._path}: {name} is {data.dtype} {data.shape}, no table of numbers; {_CURE}")
        if data.size != len(data) * width:
            hint = ", a dexterous hand" if name.endswith("effector/position") and data.size == len(data) * 12 else ""
            raise EpisodeError(f"{self._path}: {name} has shape {data.shape}, not {width} numbers a row{hint}; {_CURE}")
        rows = data[()].reshape(-1, width)
        return rows if name == "timestamp" else rows.astype(np.float64)

    def _note_empty(self, name: str) -> None:
        if name not in self.notes["empty"]:
            self.notes["empty"].append(name)
