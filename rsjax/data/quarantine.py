"""Records that could not be read: listed in one file, counted over all processes and restarts, few enough to go on."""

import contextlib
import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from filelock import lock_descriptor

from rsjax.data.store import StoreError
from rsjax.files import disk_guard

NAME = "quarantine.jsonl"
MAX_DAMAGED = 0.01  # share of the records that training goes on without

_log = logging.getLogger(__name__)

Key = tuple[str, str, int]


class Quarantine:
    """The damaged records of one training run. Can be sent to other processes, which then share the list.

    Args:
        path: the list, a JSON object per line with ``store`` (as seen from the list), ``split``, ``record``, ``file``
            and ``error``; made with the first damaged record. None: the list is in this process's memory.
        records: how many records there are.
        share: of the records that may be damaged. A single one always may, unless the share is 0.
    """

    def __init__(self, path: Path | None, records: int, share: float = MAX_DAMAGED) -> None:
        self._path, self._records = path, records
        self._most = max(1, int(share * records)) if share else 0
        self._known: set[Key] = set()  # that this process met

    def note(self, place: dict[str, Any], error: StoreError, instead: str = "the next record is used instead") -> None:
        """Lists a record as damaged, if it is not listed yet.

        Args:
            place: the record's ``store``, ``split``, ``record`` and ``file``, as far as it has them.
            error: why it cannot be read.
            instead: what is done about it, for the log.

        Raises:
            StoreError: too many are damaged, or the list cannot be written.
        """
        if self._path is not None and os.path.isabs(place.get("store", "")):  # a run may be moved, with what it reads
            place = place | {"store": os.path.relpath(place["store"], self._path.parent)}
        key = _key(place)
        if key in self._known:
            return
        new, count = self._append(key, place | {"error": str(error)}) if self._path else (True, len(self._known) + 1)
        told = f"{count} of {self._records} records are damaged"
        if count > self._most:
            listed = f"; {self._path} lists them, delete it once they are mended" if self._path else ""
            raise StoreError(
                f"{error} ({told}; training goes on without at most {self._most}: max_damaged{listed})"
            ) from error
        self._known.add(key)  # not before: readers ask again after an error, and are to get it again
        if new:
            _log.warning("%s; %s (%s)", error, instead, told)

    def count(self) -> int:
        """How many records are listed."""
        if self._path is None:
            return len(self._known)
        return len(_keys(self._path.read_bytes())) if self._path.exists() else 0

    def _append(self, key: Key, row: dict[str, Any]) -> tuple[bool, int]:
        """Adds a line where no other process has; whether it was added, and how many there are now."""
        assert self._path is not None
        with disk_guard(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a+b") as file, _locked(file):
                file.seek(0)
                payload = file.read()
                keys = _keys(payload)
                if key in keys:
                    return False, len(keys)
                line = json.dumps(row).encode() + b"\n"
                # A process that was killed while it wrote has left half a line.
                file.write(line if payload.endswith(b"\n") or not payload else b"\n" + line)
                return True, len(keys) + 1


def read_quarantine(path: Path) -> list[dict[str, Any]]:
    """The list's lines, each record once; a torn line is left out. Empty where there is no list."""
    rows = _rows(path.read_bytes()) if path.exists() else []
    return list({_key(row): row for row in rows}.values())


def _key(row: dict[str, Any]) -> Key:
    return row.get("store", ""), row.get("split", ""), row["record"]


def _keys(payload: bytes) -> set[Key]:
    return {_key(row) for row in _rows(payload)}


def _rows(payload: bytes) -> list[dict[str, Any]]:
    rows = []
    for line in payload.splitlines():
        with contextlib.suppress(ValueError):
            rows.append(json.loads(line))
    return rows


@contextlib.contextmanager
def _locked(file: IO[bytes]) -> Iterator[None]:
    # Closing the file unlocks it. Where a file system has no locks a record may get two lines, but counts once.
    with contextlib.suppress(OSError):
        lock_descriptor(file.fileno())
    yield
