"""Reads and writes stores: a directory, written atomically, of ArrayRecord shards per split and a ``manifest.json``.

Records are dicts that :mod:`rsjax.data.codec` encodes; a :class:`rsjax.clip.Clip` is one kind of record.
"""

import dataclasses
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from array_record.python.array_record_data_source import ArrayRecordDataSource
from array_record.python.array_record_module import ArrayRecordWriter

from rsjax.clip import Clip
from rsjax.data.codec import Record, decode, encode
from rsjax.data.labels import Label, Labels, LabelWriter
from rsjax.data.manifest import FORMAT, ManifestError, check_manifest
from rsjax.files import FileError, checked_path, disk_guard, placeholder, read_json, replace_directory

MANIFEST = "manifest.json"
WRITER_OPTIONS = "group_size:1,zstd:1"  # one record per group: random access reads no more than it returns
SHARD_BYTES = 256 * 2**20
NO_ARRAY = "none"  # in place of a shape, for an array that a record does not have


class StoreError(FileError):
    """A store cannot be read or written. The message names the file and the cure."""


class RecordSource(Protocol):
    """Random access to records, such as a :class:`Source`."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Record: ...


def encode_clip(clip: Clip) -> Record:
    """Returns a clip as a record, in which a second view that the clip lacks is left out."""
    record = {field.name: getattr(clip, field.name) for field in dataclasses.fields(Clip)}
    if clip.second is None:
        del record["second"]
    return record


class Source:
    """Random access to the records of one split: ``len(source)``, ``source[i]``. It can be sent to other processes.

    Args:
        store: the store's directory.
        split: the split's name.
        files: name and number of records of each shard, in order.

    Raises:
        StoreError: on reading a damaged record; the message names the file and the record.
    """

    def __init__(self, store: Path, split: str, files: list[tuple[str, int]]) -> None:
        self._store = store
        self._split = split
        self._paths = [store / name for name, _ in files]
        self._starts = np.cumsum([0, *(count for _, count in files)])
        self._reader: Any = None

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_reader": None}

    def __getitem__(self, index: int) -> Record:
        if isinstance(index, bool) or not isinstance(index, int | np.integer):
            raise StoreError(f"record {index!r:.80} of a split; records are numbered from 0 to {len(self) - 1}")
        if not 0 <= index < len(self):
            raise IndexError(f"record {index!r:.80} of a split with {len(self)} records")
        for _ in range(2):  # a stale file handle is not damage, so the shards are opened once more
            try:
                reader = self._reader  # another thread may reset the attribute
                if reader is None:
                    reader = ArrayRecordDataSource([str(path) for path in self._paths])
                    self._reader = reader
                return decode(reader[index])
            except Exception as error:  # array_record reports damage with several exception types
                self._reader = None
                damage = error
        shard = self._shard(index)
        raise StoreError(
            f"{self._paths[shard]}: record {index - self._starts[shard]} (number {index} of the split) cannot be "
            f"read: {damage}; delete {self._paths[shard].parent} and make it again"
        ) from damage

    def _shard(self, index: int) -> int:
        return int(np.searchsorted(self._starts, index, side="right")) - 1

    def locate(self, index: int) -> dict[str, Any]:
        """Returns where a record is, JSON-ready: ``store``, ``split``, ``record`` (its number there) and ``file``."""
        return {
            "store": str(self._store.absolute()),
            "split": self._split,
            "record": int(index),
            "file": self._paths[self._shard(index)].name,
        }


@dataclasses.dataclass(frozen=True)
class Store:
    """An opened store.

    Attributes:
        path: its directory.
        manifest: the content of its ``manifest.json``: ``format``, ``kind``, ``splits`` (name → ``files``, ``count``)
            and the ``meta`` of :func:`write_store`.
    """

    path: Path
    manifest: dict[str, Any]

    @property
    def splits(self) -> tuple[str, ...]:
        return tuple(self.manifest["splits"])

    def source(self, split: str) -> Source:
        """Returns the records of one split."""
        entry = self._entry(split)
        return Source(self.path, split, [(file["name"], file["count"]) for file in entry["files"]])

    def counts(self) -> dict[str, int]:
        """Returns the number of records of each split."""
        return {split: len(self.source(split)) for split in self.splits}

    def shapes(self) -> dict[str, str]:
        """Returns type and shape of each array of the first record; ``NO_ARRAY`` for an array that is missing."""
        source = next((source for source in map(self.source, self.splits) if len(source)), None)
        return {
            name: NO_ARRAY if value is None else f"{value.dtype} {value.shape}"
            for name, value in (source[0] if source else {}).items()
            if value is None or hasattr(value, "dtype")
        }

    def labelled(self, split: str) -> bool:
        """Returns whether the records of one split have labels."""
        return "labels" in self._entry(split)

    def labels(self, split: str) -> Labels:
        """Returns the labels of the records of one split.

        Raises:
            StoreError: the store was written without labels, or they are damaged.
        """
        entry = self._entry(split).get("labels")
        cure = f"delete {self.path} and make it again"
        if entry is None:
            raise StoreError(f"{self.path / MANIFEST}: names no task and difficulty of its {split} records; {cure}")
        try:
            return Labels.read(self.path / entry["name"], entry)
        except (OSError, ValueError) as error:
            raise StoreError(f"{self.path / entry['name']}: cannot be read ({error}); {cure}") from error

    def _entry(self, split: str) -> dict[str, Any]:
        if not isinstance(split, str) or split not in self.manifest["splits"]:
            raise StoreError(f"{self.path}: no split {split!r:.80}; it has {', '.join(self.splits)}")
        return self.manifest["splits"][split]


def open_store(path: Path | str) -> Store:
    """Opens a store, which may come from elsewhere, and checks that all its files are there and complete.

    Raises:
        StoreError: there is no store; its manifest or a shard is missing, truncated, of another format or out of reach
            (permissions, a loop of links); or its manifest names a file outside the store or an impossible size. The
            message says to delete the directory only if it contains shards, so that nobody deletes their recordings.
    """
    try:
        path = checked_path(path, "path")
    except FileError as error:
        raise StoreError(str(error)) from error
    place = path / MANIFEST
    again = f"delete {path} and make it again"
    ours = any(path.glob("*.array_record"))
    cure = again if ours else "give a store, or make one with rsjax ingest"
    if not ours and not os.path.lexists(place):
        raise StoreError(f"{path}: {f'no store (it has no {MANIFEST})' if path.exists() else 'not there'}; {cure}")
    try:
        manifest = read_json(place, cure=cure)
        check_manifest(manifest)
    except ManifestError as error:
        raise StoreError(f"{place}: {error}; {cure}") from error
    except FileError as error:
        raise StoreError(str(error)) from error
    for entry in manifest["splits"].values():
        for file in entry["files"] + ([entry["labels"]] if "labels" in entry else []):
            shard = path / file["name"]
            try:
                size = shard.stat().st_size
            except FileNotFoundError as error:
                raise StoreError(f"{shard}: missing; {again}") from error
            except OSError as error:
                raise StoreError(f"{shard}: cannot be read ({error.strerror}); mend the link or permission") from error
            if size != file["bytes"]:
                instead = placeholder(shard) or f"{size} bytes, should be {file['bytes']}; {again}"
                raise StoreError(f"{shard}: {instead}")
    return Store(path, manifest)


def complete_key(path: Path | str) -> str | None:
    """Returns the content key of a complete store, or None if there is none."""
    try:
        return open_store(path).manifest.get("key")
    except StoreError:
        return None


def write_store(
    path: Path | str,
    kind: str,
    splits: Mapping[str, Iterable[Record]],
    meta: dict[str, Any],
    label: Label | None = None,
) -> None:
    """Writes a store; replaces an older one at the same path only when the new one is complete.

    Args:
        path: the store's directory.
        kind: kind of the records, such as ``"clips"``.
        splits: records of each split, read once and in order.
        meta: further fields of the manifest, JSON-ready; ``key`` is the content key that :func:`complete_key` returns.
        label: returns a record's labels by column, kept for :meth:`Store.labels`.

    Raises:
        FileError: the disk is full or cannot be written to.
        StoreError: ``path`` holds something that is not a store.
    """
    path = Path(path)
    if path.exists() and not (path / MANIFEST).exists():
        raise StoreError(f"{path}: exists and is not a store; move it away or choose another place")
    building = path.with_name(f"{path.name}.building")
    with disk_guard(path):
        shutil.rmtree(building, ignore_errors=True)
        building.mkdir(parents=True)
        try:
            entries = {split: _write_split(building, split, records, label) for split, records in splits.items()}
            manifest = {"format": FORMAT, "kind": kind, "splits": entries} | meta
            (building / MANIFEST).write_text(json.dumps(manifest, indent=1))
            replace_directory(building, path)
        finally:
            shutil.rmtree(building, ignore_errors=True)


def _write_split(folder: Path, split: str, records: Iterable[Record], label: Label | None) -> dict[str, Any]:
    """Writes the shards and labels of one split and returns its entry in the manifest."""
    labels = LabelWriter()
    files: list[dict[str, Any]] = []
    payloads = map(encode, labels.noting(records, label) if label else records)
    payload = next(payloads, None)
    while payload is not None:
        name = f"{split}-{len(files):05d}.array_record"
        count = 0
        size = 0
        writer = ArrayRecordWriter(str(folder / name), WRITER_OPTIONS)
        while payload is not None and size < SHARD_BYTES:
            writer.write(payload)
            count += 1
            size += len(payload)
            payload = next(payloads, None)
        writer.close()
        files.append({"name": name, "count": count, "bytes": (folder / name).stat().st_size})
    entry: dict[str, Any] = {"files": files, "count": sum(file["count"] for file in files)}
    return entry | ({"labels": labels.write(folder / f"{split}-labels.npy")} if label and files else {})
