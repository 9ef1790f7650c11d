"""Reads the tables of a LeRobotDataset: the rows of one episode, and pictures that are encoded in them."""

import bisect
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import UInt8

from rsjax.tools.ingest.episode import EpisodeError
from rsjax.tools.ingest.formats.files import inside, integers, parquet_columns
from rsjax.tools.ingest.pictures import decode_pictures

_ALL = [("episode_index", ">=", 0)]  # a shared file may have more rows than the limit for one episode


def read_rows(root: Path, template: str, location: dict[str, Any], columns: Sequence[str]) -> tuple[Path, pa.Table]:
    """Reads the rows of an episode.

    LeRobot's converter to v3 writes wrong metadata: for the first episode of every file but the first it names the
    previous file, and if the very first episode alone exceeds a file's size it names a file that does not exist. So if
    the file that the metadata name is missing or has no row of the episode, the other files are searched, the next one
    first.

    Args:
        template: template of the tables' paths.
        location: the episode's location.
        columns: the columns to read; those that the table lacks are left out.

    Returns:
        The file that has the rows, and the rows.

    Raises:
        EpisodeError: the named file cannot be read, or no file has a row of the episode.
    """
    named, number = inside(root, location["data"]), location["episode"]
    failure = EpisodeError.at(named, f"has no row of episode {number}, nor has any other file", kind="length")
    shared = "rows" in location
    for path in (named, *(_others(root, template, named, number) if shared else ())):
        try:
            table = parquet_columns(path, columns, _only(location))
        except EpisodeError as error:
            if not (shared and isinstance(error.__cause__, FileNotFoundError)):
                raise
            failure = error
        else:
            if table.num_rows:
                return path, table
    raise failure


def _others(root: Path, template: str, named: Path, number: int) -> Iterator[Path]:
    """Yields the other files that have rows of an episode; files that cannot be read are skipped."""
    pattern = inside(root, re.sub(r"\{[^{}]*\}", "*", template)).relative_to(root)
    files = sorted(root.glob(str(pattern)))
    after = bisect.bisect_right(files, named)
    for path in (*files[after:], *reversed(files[:after])):
        try:
            status = path.stat()
            if number in _episodes_in(path, status.st_size, status.st_mtime_ns):
                yield path
        except (EpisodeError, OSError):
            continue


@lru_cache(maxsize=4096)
def _episodes_in(path: Path, size: int, modified: int) -> frozenset[int]:
    """Returns the episodes of a file; ``size`` and ``modified`` make the cache read a changed file again."""
    table = parquet_columns(path, ["episode_index"], _ALL)
    return frozenset(np.unique(integers(table, "episode_index", path)).tolist())


def _only(location: dict[str, Any]) -> list[tuple[str, str, int]] | None:
    """Returns the filter that selects one episode from a shared table; None if the table holds only this episode."""
    return [("episode_index", "==", location["episode"])] if "rows" in location else None


@dataclass(frozen=True, eq=False)
class TablePictures:
    """Encoded pictures in an episode's table, as :class:`rsjax.tools.ingest.episode.Frames`.

    Attributes:
        path: the table.
        column: a column of ``{bytes, path}``.
        location: the episode's location.
    """

    path: Path
    column: str
    location: dict[str, Any]

    def __len__(self) -> int:
        return self.location["length"]

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        """Returns these pictures; :class:`EpisodeError` names one that is missing or damaged."""
        table = parquet_columns(self.path, [self.column], _only(self.location))
        if self.column not in table.column_names:
            raise EpisodeError.at(self.path, f"has no column {self.column!r}")
        if table.num_rows != len(self):
            raise EpisodeError.at(self.path, f"{table.num_rows} rows of {self.column}, not {len(self)}")
        cells = table[self.column].take(list(indices)).to_pylist()
        payloads: list[tuple[str, bytes]] = []
        for index, cell in zip(indices, cells, strict=True):
            where = f"{self.path}: {self.column} of row {index}"
            payload = cell.get("bytes") if isinstance(cell, dict) else cell
            if not isinstance(payload, bytes):
                raise EpisodeError.at(where, "has no encoded picture", kind="undecodable")
            payloads.append((where, payload))
        return decode_pictures(payloads)
