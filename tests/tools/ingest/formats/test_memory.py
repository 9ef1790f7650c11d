"""Memory stays flat in the size of a data set: of fifty episodes no more is held than of the first ten."""

import ctypes
import gc
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rsjax.data.store import Record, write_store
from rsjax.tools.ingest.episode import EpisodeRef, EpisodeSource
from rsjax.tools.ingest.formats import open_source
from tests.tools.ingest.formats.test_lerobot import V3_PATHS, write_info
from tests.tools.ingest.formats.toy_demos import write_demos
from tests.tools.ingest.formats.toy_tfrecord import bridge_episode, write_bridge

EPISODES = 50
FIRST = 10
STEPS = 12
SIDE = 128
MOST = 16 * 2**20  # bytes; fifty episodes that are held take 29 MB and more
NOISE = np.random.default_rng(0).integers(0, 255, (STEPS, SIDE, SIDE, 3), np.uint8)


def robomimic(root: Path) -> None:
    arrays = {"actions": np.ones((STEPS, 7)), "obs/front_image": NOISE}
    write_demos(root / "a.hdf5", {f"demo_{number}": arrays for number in range(EPISODES)})


def rlds(root: Path) -> None:
    pictures = [cv2.imencode(".png", picture)[1].tobytes() for picture in NOISE]
    write_bridge(root, [bridge_episode(STEPS, changes={"steps/observation/image_0": pictures})] * EPISODES)


def table(episode: int, first: int, pictures: bool) -> dict[str, Any]:
    rows = {
        "action": np.ones((STEPS, 2), np.float32).tolist(),
        "timestamp": pa.array(np.arange(STEPS, dtype=np.float32) / 10, pa.float32()),
        "frame_index": list(range(STEPS)),
        "episode_index": [episode] * STEPS,
        "index": list(range(first, first + STEPS)),
    }
    cells = [{"bytes": cv2.imencode(".png", picture)[1].tobytes(), "path": None} for picture in NOISE]
    return rows | ({"observation.image": cells} if pictures else {})


def lerobot(root: Path) -> None:
    """Pictures of all episodes in one table."""
    features = {"action": {"dtype": "float32"}, "observation.image": {"dtype": "image"}}
    write_info(root, "v3.0", V3_PATHS, features=features, total_episodes=EPISODES)
    whole = pa.table(table(0, 0, pictures=True))
    (root / "data/chunk-000").mkdir(parents=True)
    with pq.ParquetWriter(root / "data/chunk-000/file-000.parquet", whole.schema) as writer:
        for episode in range(EPISODES):
            changed = pa.table(table(episode, episode * STEPS, pictures=False))
            writer.write_table(changed.append_column("observation.image", whole["observation.image"]))
    ends = [number * STEPS for number in range(EPISODES + 1)]
    meta = {
        "episode_index": list(range(EPISODES)),
        "tasks": [["pick"]] * EPISODES,
        "length": [STEPS] * EPISODES,
        "dataset_from_index": ends[:-1],
        "dataset_to_index": ends[1:],
        "data/chunk_index": [0] * EPISODES,
        "data/file_index": [0] * EPISODES,
    }
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(pa.table(meta), root / "meta/episodes/chunk-000/file-000.parquet")
    pq.write_table(pa.table({"task_index": [0], "task": ["pick"]}), root / "meta/tasks.parquet")


def sim(root: Path) -> None:
    root.rmdir()
    clip: Record = {
        "rgb": NOISE,
        "depth": None,
        "actions": np.ones((STEPS, 7), np.float32),
        "task": "go",
        "provenance": {},
    }
    write_store(root, "clips", {"train": (clip for _ in range(EPISODES))}, {})


WRITERS: dict[str, Callable[[Path], None]] = {writer.__name__: writer for writer in (lerobot, robomimic, rlds, sim)}


def peak() -> int:
    """The most bytes that this process has held since :func:`forget`."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) * 1024


def forget() -> None:
    """Gives back what is free, in which a leak would go unnoticed, and begins to measure."""
    gc.collect()
    pa.default_memory_pool().release_unused()
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")


def read_all(source: EpisodeSource, refs: Iterator[EpisodeRef]) -> None:
    for ref in refs:
        episode = source.read(ref)
        for frames in episode.cameras.values():
            for start in range(0, len(frames), 5):
                frames.read(range(start, min(start + 5, len(frames))))


def cost(source: EpisodeSource, episodes: int) -> int:
    """Bytes that reading so many episodes takes at most, above what the process had before."""
    forget()
    before = peak()
    read_all(source, islice(source.episodes(), episodes))
    return peak() - before


@pytest.mark.parametrize("name", WRITERS)
def test_memory_does_not_grow_with_the_number_of_episodes(name: str, tmp_path: Path) -> None:
    (root := tmp_path / "set").mkdir()
    WRITERS[name](root)
    source = open_source(name, root)
    assert sum(1 for _ in source.episodes()) == EPISODES
    try:
        cost(source, FIRST)  # what libraries take once is not the data set's
        few = cost(source, FIRST)
    except (AttributeError, OSError):
        pytest.skip("this system does not let a process forget how much memory it had")
    assert cost(source, EPISODES) - few < MOST
