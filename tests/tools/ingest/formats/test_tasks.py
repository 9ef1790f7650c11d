"""Data sets that name no task, each in its own way: null is no text "None", and clips say ``unknown``."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rsjax.clip import words_of
from rsjax.data.build import clip_labels
from rsjax.tools.ingest.annotate import Annotated
from rsjax.tools.ingest.clips import ClipConfig, cut
from rsjax.tools.ingest.windows import WindowConfig
from tests.tools.ingest.formats.reading import read_all
from tests.tools.ingest.formats.test_folder import write_episode
from tests.tools.ingest.formats.test_lerobot import write_v2, write_v3
from tests.tools.ingest.formats.toy_demos import demo, write_demos


def folder(root: Path, task: Any) -> None:
    segments = [{"start": 0, "end": 4, "text": task}]
    (write_episode(root) / "episode.json").write_text(json.dumps({"task": task, "segments": segments}))
    (root / "dataset.json").write_text(json.dumps({"task": task}))


def lerobot_v2(root: Path, task: Any) -> None:
    write_v2(root)
    (root / "meta/tasks.jsonl").write_text(
        "".join(json.dumps({"task_index": index, "task": task}) + "\n" for index in range(2))
    )
    lines = [json.loads(line) for line in (root / "meta/episodes.jsonl").read_text().splitlines()]
    (root / "meta/episodes.jsonl").write_text("".join(json.dumps(line | {"tasks": [task]}) + "\n" for line in lines))


def lerobot_v3(root: Path, task: Any) -> None:
    write_v3(root)
    tasks = pa.table({"task_index": [0, 1], "task": pa.array([task, task], pa.string())})
    pq.write_table(tasks, root / "meta/tasks.parquet")


def robomimic(root: Path, task: Any) -> None:
    path = write_demos(root / "a.hdf5", {"demo_0": demo(8)}, env_args={"env_name": task})
    with h5py.File(path, "a") as file:
        file["data/demo_0"].attrs["ep_meta"] = json.dumps({"lang": task})


def npz(root: Path, task: Any) -> None:
    frames = np.random.default_rng(0).integers(0, 255, (8, 16, 16, 3), np.uint8)
    named = {} if task is None else {"task": task}
    np.savez(root / "a.npz", frames=frames, actions=np.ones((8, 2)), kind="delta", fps=10, **named)


@pytest.mark.parametrize("task", [None, "  \n"])
@pytest.mark.parametrize("write", [folder, lerobot_v2, lerobot_v3, robomimic, npz])
def test_no_task_is_unknown(tmp_path: Path, write: Callable[[Path, Any], None], task: Any) -> None:
    write(tmp_path, task)
    windows = ClipConfig(WindowConfig(frames=3, rate=0), image_size=8, tracks=1)
    for episode in read_all(write.__name__.partition("_")[0], tmp_path):
        assert episode.task == "" and not any(segment.text for segment in episode.segments)
        for clip in cut(Annotated(episode, task=episode.task), windows):
            assert clip["task"] == clip_labels(clip)["task"] == "unknown" and "None" not in clip_labels(clip).values()


def test_words() -> None:
    assert [words_of(value) for value in (None, float("nan"), " a ", "", 3)] == ["", "", "a", "", "3"]
