"""Reads a ``proprio_stats.h5`` of AgiBot-World: states, and commands extended to all frames.

Axes: N frames, M ≤ N commands, D dimensions.
"""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float32, Float64, Int64

from rsjax.tools.ingest.actions import continuous_signs
from rsjax.tools.ingest.episode import LEAVE_OUT, EpisodeError
from rsjax.tools.ingest.formats.files import MAX_CELLS
from rsjax.tools.ingest.formats.hdf5 import member

_WIDTHS = {
    "end/position": 6,
    "end/orientation": 8,
    "effector/position": 2,
    "joint/position": 14,
    "head/position": 2,
    "waist/position": 2,
}


class Proprio:
    """The arrays of an open file, each flattened to (rows, D).

    Attributes:
        notes: what had to be repaired, JSON-ready: fields that are empty, commands that do not cover all frames,
            quaternions that changed sign.
    """

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._file, self._path = file, path
        self.notes: dict[str, Any] = {"empty": [], "scattered": {}, "flipped": {}}
        self._stamps = self._rows("timestamp", 1)[:, 0]
        self._count = len(self._stamps)
        if not self._count:
            raise self._error("timestamp is missing or empty")

    def _error(self, problem: str) -> EpisodeError:
        return EpisodeError.at(self._path, problem, LEAVE_OUT)

    def seconds(self) -> Float64[np.ndarray, " N"]:
        """Returns the seconds since the first frame; the file has nanoseconds."""
        whole = self._stamps.dtype.kind in "iu"
        stamps = self._stamps.astype(np.int64) if whole else self._stamps  # differences of unsigned ones wrap around
        return (stamps - stamps[0]).astype(np.float64) / 1e9

    def states(self) -> Float32[np.ndarray, "N 34"]:
        """Positions (6, m), orientations (8), grippers (2, mm), joints (14, rad), head (2, rad), waist (2, rad, m)."""
        parts = {name: self._state(name) for name in _WIDTHS}
        parts["end/orientation"] = self.quaternions("state/end/orientation")
        with np.errstate(over="ignore"):  # values beyond float32 become infinite, which is refused later
            return np.concatenate(list(parts.values()), 1).astype(np.float32)

    def quaternions(self, name: str) -> Float64[np.ndarray, "N 8"]:
        """Returns both hands' quaternions at every frame, each with continuous signs. Raises as :meth:`command`."""
        kind, _, field = name.partition("/")
        pair = self._state(field) if kind == "state" else self.command(field)
        mended = np.concatenate([continuous_signs(pair[:, :4]), continuous_signs(pair[:, 4:])], 1)
        if rows := int((mended != pair).any(1).sum()):
            self.notes["flipped"][name] = rows
        return mended

    def command(self, name: str) -> Float64[np.ndarray, "N D"]:
        """Returns ``action/name`` at every frame; the state where no command was sent, zeros if the field is empty.

        Raises:
            EpisodeError: there are more commands than frames, or it is unknown at which frames they were sent.
        """
        commands = self._commands(name)
        if not len(commands):
            return np.zeros((self._count, _WIDTHS[name]))
        extended = self._state(name)
        extended[self._index(name, len(commands))] = commands
        return extended

    def grippers(self) -> Float64[np.ndarray, "N 2"]:
        """Returns ``action/effector/position`` at every frame: the last command sent, and 0 (open) before the first.

        The state cannot replace it, because it is in millimetres. Raises as :meth:`command`.
        """
        commands = self._commands("effector/position")
        extended = np.zeros((self._count, 2))
        if len(commands):
            index = self._index("effector/position", len(commands))
            last = np.searchsorted(index, np.arange(self._count), side="right") - 1
            extended[last >= 0] = commands[last[last >= 0]]
        return extended

    def copied(self) -> bool:
        """Returns whether the hands' commands equal the states at the same frames, so that they predict nothing."""
        for name in ("end/position", "end/orientation"):
            commands = self._commands(name)
            if not len(commands):
                return False
            index = self._index(name, len(commands))
            if not np.allclose(commands, self._state(name)[index], rtol=0, atol=1e-6):
                return False
        return True

    def _state(self, name: str) -> Float64[np.ndarray, "N D"]:
        rows = self._noted_rows(f"state/{name}", _WIDTHS[name])
        if not len(rows):
            return np.zeros((self._count, _WIDTHS[name]))
        if len(rows) != self._count:
            raise self._error(f"state/{name} has {len(rows)} rows, timestamp {self._count}")
        return rows

    def _commands(self, name: str) -> Float64[np.ndarray, "M D"]:
        rows = self._noted_rows(f"action/{name}", _WIDTHS[name])
        if len(rows) > self._count:
            raise self._error(f"action/{name} has {len(rows)} rows, more than {self._count}")
        return rows

    def _index(self, name: str, count: int) -> Int64[np.ndarray, " M"]:
        """Returns the frames at which the commands of a field were sent."""
        if count == self._count:
            return np.arange(count)
        for chosen in (f"action/{name.partition('/')[0]}/index", "action/joint/index"):
            if len(index := self._rows(chosen, 1)[:, 0]):
                break
        if len(index) != count:
            raise self._error(f"action/{name} has {count} rows, {chosen} {len(index)}")
        places = index.astype(np.int64)
        if (places != index).any() or places[0] < 0 or places[-1] >= self._count or (np.diff(places) <= 0).any():
            raise self._error(f"{chosen} is not increasing within 0 … {self._count - 1}")
        self.notes["scattered"][name] = count
        return places

    def _noted_rows(self, name: str, width: int) -> np.ndarray:
        """Returns :meth:`_rows`, and notes a field that is empty."""
        rows = self._rows(name, width)
        if not len(rows) and name not in self.notes["empty"]:
            self.notes["empty"].append(name)
        return rows

    def _rows(self, name: str, width: int) -> np.ndarray:
        """Reads a data set as (rows, width), with no rows if it is missing or empty; float64, but times as stored."""
        data = member(self._file, name, self._path)
        if not isinstance(data, h5py.Dataset) or not data.size:
            return np.zeros((0, width))
        if data.size > MAX_CELLS or data.dtype.kind not in "fiu" or not data.ndim:
            raise self._error(f"{name} is {data.dtype} {data.shape}, no table of numbers")
        if data.size != len(data) * width:
            hint = ", a dexterous hand" if name.endswith("effector/position") and data.size == len(data) * 12 else ""
            raise self._error(f"{name} has shape {data.shape}, not {width} numbers a row{hint}")
        rows = data[()].reshape(-1, width)
        return rows if name == "timestamp" else rows.astype(np.float64)
