"""Lists damaged records in one file, over all processes and restarts, and raises if there are too many."""

import contextlib
import json
import logging
import os
from pathlib import Path
from typing import Any

from filelock import lock_descriptor

from rsjax.data.store import StoreError
from rsjax.files import disk_guard, parse_json, regular

NAME = "quarantine.jsonl"
MAX_DAMAGED = 0.01  # share of the records that may be damaged

_log = logging.getLogger(__name__)

Key = tuple[str, str, int]


class Quarantine:
    """The damaged records of one training run. It can be sent to other processes, which then share the list.

    Args:
        path: the list, one JSON object per line with ``store`` (relative to the list), ``split``, ``record``, ``file``
            and ``error``; made with the first damaged record. None: the list is in this process's memory.
        records: number of records.
        share: share of the records that may be damaged. One damaged record is always allowed, unless the share is 0.
    """

    def __init__(self, path: Path | None, records: int, share: float = MAX_DAMAGED) -> None:
        self._path = path
        self._records = records
        self._most = max(1, int(share * records)) if share else 0
        self._known: set[Key] = set()  # records that this process has met

    def note(self, place: dict[str, Any], error: StoreError, instead: str = "the next record is used instead") -> None:
        """Lists a record as damaged, if it is not listed yet.

        Args:
            place: the record's ``store``, ``split``, ``record`` and ``file``, as far as they are known.
            error: why the record cannot be read.
            instead: what happens instead, for the log.

        Raises:
            StoreError: too many records are damaged.
            FileError: the list cannot be written.
        """
        if self._path is not None and os.path.isabs(place.get("store", "")):  # a run may be moved with its stores
            place = place | {"store": os.path.relpath(place["store"], self._path.parent)}
        key = _key(place)
        if key in self._known:
            return
        row = place | {"error": str(error)}
        new, count = self._append(self._path, key, row) if self._path else (True, len(self._known) + 1)
        state = f"{count} of {self._records} records are damaged"
        if count > self._most:
            listed = f"; {self._path} lists them, delete it once they are mended" if self._path else ""
            raise StoreError(
                f"{error} ({state}; training goes on without at most {self._most}: max_damaged{listed})"
            ) from error
        self._known.add(key)  # only now, so that a reader that retries gets the error again
        if new:
            _log.warning("%s; %s (%s)", error, instead, state)

    def count(self) -> int:
        """Returns how many records are listed."""
        return len(self._known) if self._path is None else len(read_quarantine(self._path))

    def _append(self, path: Path, key: Key, row: dict[str, Any]) -> tuple[bool, int]:
        """Adds a line unless the record is listed; returns whether it did, and how many records are listed now."""
        with disk_guard(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a+b") as file:  # closing it unlocks it
                with contextlib.suppress(OSError):  # without locks a record may get two lines, but counts once
                    lock_descriptor(file.fileno())
                file.seek(0)
                payload = file.read()
                listed = _rows(payload)
                if key in listed:
                    return False, len(listed)
                line = json.dumps(row).encode() + b"\n"
                # A process that was killed while writing may have left half a line.
                file.write(line if payload.endswith(b"\n") or not payload else b"\n" + line)
                return True, len(listed) + 1


def read_quarantine(path: Path) -> list[dict[str, Any]]:
    """Returns the rows of a list: each record once, without incomplete lines; none if there is no list.

    Raises:
        FileError: the list cannot be read.
    """
    with disk_guard(path):
        return list(_rows(regular(path).read_bytes()).values()) if path.exists() else []


def _key(row: dict[str, Any]) -> Key:
    return row.get("store", ""), row.get("split", ""), row["record"]


def _rows(payload: bytes) -> dict[Key, dict[str, Any]]:
    rows = []
    for line in payload.splitlines():
        with contextlib.suppress(ValueError):  # an incomplete line
            row = parse_json(line)
            if type(row.get("record")) is int and {type(row.get(name, "")) for name in ("store", "split")} == {str}:
                rows.append(row)
    return {_key(row): row for row in rows}
