"""Numbered records, in memory and in stores, some of them damaged."""

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.data.codec import Record
from rsjax.data.store import Store, StoreError, open_store, write_store

TASKS = ("pick up", "pick out", "place")
DIFFICULTIES = ("simple", "difficult")


class Numbers:
    """Records that say their number, of which some cannot be read."""

    def __init__(self, count: int, first: int = 0, bad: Iterable[int] = ()) -> None:
        self._count, self._first, self._bad = count, first, set(bad)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Record:
        if index in self._bad:
            raise StoreError(f"shard: record {index} cannot be read")
        return {"i": np.array(self._first + index)}


def jitter(record: Record, rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {"i": record["i"], "random": rng.random(2)}


def record(number: int) -> Record:
    """One with a task, two of three of a kind, and a difficulty, each other one's."""
    noise = np.random.default_rng(number).integers(0, 255, 500, np.uint8)
    provenance = {"episode": number}
    task, difficulty = TASKS[number % 3], DIFFICULTIES[number % 2]
    return {"i": np.array(number), "noise": noise, "task": task, "difficulty": difficulty, "provenance": provenance}


def store(path: Path, count: int, first: int = 0, **meta: Any) -> Store:
    """A labelled store of :func:`record`."""
    splits = {"train": map(record, range(first, first + count))}
    write_store(path, "numbers", splits, meta, lambda r: {"task": r["task"], "difficulty": r["difficulty"]})
    return open_store(path)


def damage(path: Path, number: int) -> None:
    """Makes a record of a store unreadable."""
    shard = path / "train-00000.array_record"
    payload = bytearray(shard.read_bytes())
    place = payload.find(record(number)["noise"].tobytes()[100:140])
    assert place > 0
    payload[place] ^= 255
    shard.write_bytes(bytes(payload))


def take(loader: Any, count: int) -> dict[str, np.ndarray]:
    """Some batches, each array stacked."""
    rows = list(itertools.islice(loader, count))
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def assert_same(left: dict[str, np.ndarray], right: dict[str, np.ndarray]) -> None:
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_array_equal(left[name], right[name])
