"""Small clips whose contents say which they are."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.data.codec import Record
from rsjax.data.normalization import Statistics
from rsjax.data.store import Store, open_store, write_store

DIFFICULTIES = ("simple", "difficult")


def clip(number: int, depth_range: list[float] | None, frames: int = 4, size: int = 8) -> Record:
    rng = np.random.default_rng(number)
    depth = None if depth_range is None else np.full((frames, size, size), depth_range[0], np.float32)
    tracks = np.zeros((5, frames, 2), np.float32) + 0.01 * np.arange(frames, dtype=np.float32)[:, None]
    return {
        "rgb": np.full((frames, size, size, 3), number, np.uint8),
        "depth": depth,
        "actions": rng.normal(number, 1, (frames, 3)).astype(np.float32),
        "tracks": tracks,
        "visible": np.ones((5, frames), bool),
        "success": np.arange(frames) >= (frames if number % 3 else frames - 1),
        "task": f"task {number % 3}",
        "provenance": {"number": number, "depth_range": depth_range, "difficulty": DIFFICULTIES[number % 2]},
    }


def clip_store(
    path: Path,
    first: int = 0,
    count: int = 6,
    depth_range: list[float] | None = None,
    counted: bool = True,
    kind: str = "clips",
    **sizes: int,
) -> Store:
    """``count`` train clips from ``first`` on, and two test clips (90 and 91), labelled, with their statistics."""

    def made(numbers: range) -> Iterator[Record]:
        return (clip(number, depth_range, **sizes) for number in numbers)

    numbers = range(first, first + count)
    rows = np.concatenate([record["actions"][1:] for record in made(numbers)])
    statistics = Statistics.of(rows).to_json()
    if not counted:
        statistics = {name: statistics[name] for name in ("action_mean", "action_std")}
    share = np.mean([number % 3 == 0 for number in (*numbers, 90, 91)])
    meta: dict[str, Any] = {"key": path.name, "depth_range": depth_range, "success_share": float(share), **statistics}
    splits = {"train": made(numbers), "test": made(range(90, 92))}
    write_store(path, kind, splits, meta, words)
    return open_store(path)


def words(record: Record) -> dict[str, str]:
    return {"task": record["task"], "difficulty": record["provenance"]["difficulty"]}


def numbers(store: Store, split: str = "train") -> list[int]:
    source = store.source(split)
    return [source[i]["provenance"]["number"] for i in range(len(source))]
