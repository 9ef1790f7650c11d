"""The store: ArrayRecord shards per split and a ``manifest.json``, in one directory that appears whole or not at all.

A :class:`rsjax.clip.Clip` is one kind of record; :mod:`rsjax.data.codec` is how a record lies in a shard.
"""

import dataclasses
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from array_record.python.array_record_data_source import ArrayRecordDataSource
from array_record.python.array_record_module import ArrayRecordWriter

from rsjax.clip import Clip
from rsjax.data.codec import Record, decode, encode
from rsjax.data.labels import Label, Labels, LabelWriter
from rsjax.data.manifest import ManifestError, check_manifest
from rsjax.files import FileError, disk_guard, read_json, replace_directory

FORMAT = 1
MANIFEST = "manifest.json"
WRITER_OPTIONS = "group_size:1,zstd:1"  # one record a group: random access reads no more than it returns
SHARD_BYTES = 256 * 2**20


class StoreError(FileError):
    """A store that cannot be read or written. The message names the file and the cure."""


def encode_clip(clip: Clip) -> Record:
    """A clip as a record."""
    return {field.name: getattr(clip, field.name) for field in dataclasses.fields(Clip)}


def decode_clip(record: Record) -> Clip:
    """The inverse of :func:`encode_clip`."""
    return Clip(**record)


class Source:
    """Random access to one split's records: ``len(source)``, ``source[i]``. Can be sent to other processes.

    Args:
        store: the store's directory.
        split: the split's name.
        files: each shard's name and number of records, in order.

    Raises:
        StoreError: on reading a record that is damaged; it names the file and the record.
    """

    def __init__(self, store: Path, split: str, files: list[tuple[str, int]]) -> None:
        self._store, self._split = store, split
        self._paths, self._starts = [store / name for name, _ in files], np.cumsum([0, *(count for _, count in files)])
        self._reader: Any = None

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_reader": None}

    def __getitem__(self, index: int) -> Record:
        if not 0 <= index < len(self):
            raise IndexError(f"record {index} of a split with {len(self)} records")
        try:
            return self._read(index)
        except Exception:  # as below; a file handle that went stale is not damage, so it is opened once more
            self._reader = None
        try:
            return self._read(index)
        except Exception as error:  # array_record reports damage as several types
            shard = self._shard(index)
            raise StoreError(
                f"{self._paths[shard]}: record {index - self._starts[shard]} (number {index} of the split) cannot be "
                f"read: {error}; delete {self._paths[shard].parent} and make it again"
            ) from error

    def _read(self, index: int) -> Record:
        reader = self._reader  # another thread may close the one that this object has
        if reader is None:
            reader = self._reader = ArrayRecordDataSource([str(path) for path in self._paths])
        return decode(reader[index])

    def _shard(self, index: int) -> int:
        return int(np.searchsorted(self._starts, index, side="right")) - 1

    def locate(self, index: int) -> dict[str, Any]:
        """Where a record lies, JSON-ready, without reading it: store, split, its number there, and file."""
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
        manifest: what :func:`write_store` wrote: ``format``, ``kind``, ``splits`` (name → ``files`` and ``counts``)
            and everything in its ``meta``.
    """

    path: Path
    manifest: dict[str, Any]

    @property
    def splits(self) -> tuple[str, ...]:
        return tuple(self.manifest["splits"])

    def source(self, split: str) -> Source:
        """The records of one split."""
        entry = self._entry(split)
        return Source(self.path, split, [(file["name"], file["count"]) for file in entry["files"]])

    def labelled(self, split: str) -> bool:
        """Whether the store was written with labels."""
        return "labels" in self._entry(split)

    def labels(self, split: str) -> Labels:
        """What the records of one split are called.

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
        if split not in self.manifest["splits"]:
            raise StoreError(f"{self.path}: no split {split!r}; it has {', '.join(self.splits)}")
        return self.manifest["splits"][split]


def open_store(path: Path | str) -> Store:
    """Open a store, which may be somebody else's, and check that its files are all there and whole.

    Raises:
        StoreError: the place is missing or no store, the manifest or a shard is missing, truncated, of another format
            or cannot be reached (permissions, a loop of links), or the manifest names a file outside the store or an
            impossible size. To delete it is the cure only where there are shards, which nobody's own data are.
    """
    path = Path(path)
    place = path / MANIFEST
    ours = any(path.glob("*.array_record"))
    cure = f"delete {path} and make it again" if ours else "give a store, or make one with experiments.ingest"
    if not os.path.lexists(place) and not ours:
        reason = f"no store (it has no {MANIFEST})" if path.exists() else "not there"
        raise StoreError(f"{path}: {reason}; {cure}")
    try:
        manifest = read_json(place, cure=cure)
        check_manifest(manifest, FORMAT)
    except ManifestError as error:
        raise StoreError(f"{place}: {error}; {cure}") from error
    except FileError as error:
        raise StoreError(str(error)) from error
    cure = f"delete {path} and make it again"  # what has such a manifest was a store
    for entry in manifest["splits"].values():
        for file in entry["files"] + ([entry["labels"]] if "labels" in entry else []):
            shard = path / file["name"]
            try:
                size = shard.stat().st_size
            except FileNotFoundError as error:
                raise StoreError(f"{shard}: missing; {cure}") from error
            except OSError as error:
                raise StoreError(f"{shard}: cannot be read ({error.strerror}); mend the link or permission") from error
            if size != file["bytes"]:
                raise StoreError(f"{shard}: {size} bytes, should be {file['bytes']}; {cure}")
    return Store(path, manifest)


def complete_key(path: Path | str) -> str | None:
    """The content key of a whole store, ``None`` where there is no such thing."""
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
    """Write a store; it replaces an older one at the same place only when it is complete.

    Args:
        path: the store's directory.
        kind: what the records are, e.g. ``"clips"``.
        splits: each split's records, consumed once and in order.
        meta: more of the manifest, JSON-ready; ``key`` is the content key that :func:`complete_key` returns.
        label: a record's words by column, kept for :meth:`Store.labels`.

    Raises:
        StoreError: on a full disk, or where ``path`` holds something that is not a store.
    """
    path = Path(path)
    if path.exists() and not (path / MANIFEST).exists():
        raise StoreError(f"{path}: exists and is not a store; move it away or choose another place")
    building = path.with_name(f"{path.name}.building")
    with disk_guard(path):
        shutil.rmtree(building, ignore_errors=True)
        building.mkdir(parents=True)
        try:
            manifest: dict[str, Any] = {"format": FORMAT, "kind": kind, "splits": {}} | meta
            for split, records in splits.items():
                manifest["splits"][split] = _write_labelled(building, split, records, label)
            (building / MANIFEST).write_text(json.dumps(manifest, indent=1))
            replace_directory(building, path)
        finally:
            shutil.rmtree(building, ignore_errors=True)


def _write_labelled(folder: Path, split: str, records: Iterable[Record], label: Label | None) -> dict[str, Any]:
    """Write one split's shards and labels; returns the manifest's entry."""
    labels = LabelWriter()
    files = _write_split(folder, split, labels.noting(records, label) if label else records)
    entry: dict[str, Any] = {"files": files, "count": sum(file["count"] for file in files)}
    return entry | ({"labels": labels.write(folder / f"{split}-labels.npy")} if label and files else {})


def _write_split(folder: Path, split: str, records: Iterable[Record]) -> list[dict[str, Any]]:
    """Write one split's shards; returns each one's name, count and size in bytes."""
    files: list[dict[str, Any]] = []
    payloads: Iterator[bytes] = map(encode, records)
    payload = next(payloads, None)
    while payload is not None:
        name, count, size = f"{split}-{len(files):05d}.array_record", 0, 0
        writer = ArrayRecordWriter(str(folder / name), WRITER_OPTIONS)
        while payload is not None and size < SHARD_BYTES:
            writer.write(payload)
            count, size = count + 1, size + len(payload)
            payload = next(payloads, None)
        writer.close()
        files.append({"name": name, "count": count, "bytes": (folder / name).stat().st_size})
    return files
