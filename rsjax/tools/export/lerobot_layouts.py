"""The files of a LeRobotDataset: one table and video for each episode (v2.1), or for many (v3.0)."""

import json
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float32, UInt8

from rsjax.tools.export.lerobot_meta import (
    COUNTERS,
    Stats,
    column_stats,
    merged_stats,
    picture_stats,
    plain_stats,
    rows_table,
    write_tasks,
)
from rsjax.tools.export.lerobot_video import VideoFile, VideoSettings

CHUNK = 1000  # episodes (v2.1) or files (v3.0) in a folder
DATA_MEGABYTES, VIDEO_MEGABYTES = 100, 200  # sizes after which v3.0 begins another file
BUFFERED = 1000  # episodes whose metadata are written together


@dataclass(frozen=True)
class Episode:
    """One episode to write.

    Attributes:
        rgb: the episode's frames.
        columns: its ``action`` and, if it has one, its ``observation.state``.
        task: in words.
    """

    rgb: UInt8[np.ndarray, "T H W 3"]
    columns: dict[str, Float32[np.ndarray, "T D"]]
    task: str


class _Layout(ABC):
    """The part common to both versions: counters, tasks, statistics and ``info.json``."""

    data_path: str
    video_path: str

    def __init__(self, root: Path, video: VideoSettings, features: dict[str, dict[str, Any]]) -> None:
        self.root, self.video, self.features = root, video, features
        self.camera = next(name for name, feature in features.items() if feature["dtype"] == "video")
        self.episodes = self.rows = 0
        self.tasks: dict[str, int] = {}
        (root / "meta").mkdir()

    def add(self, episode: Episode) -> None:
        """Writes the next episode."""
        count = len(episode.rgb)
        task = self.tasks.setdefault(episode.task, len(self.tasks))
        steps = np.arange(count)
        numbers = [
            steps / self.video.fps,
            steps,
            np.full(count, self.episodes),
            self.rows + steps,
            np.full(count, task),
        ]
        counters = zip(COUNTERS.items(), numbers, strict=True)
        columns = episode.columns | {name: values.astype(dtype) for (name, dtype), values in counters}
        stats = {self.camera: picture_stats(episode.rgb)}
        stats |= {name: column_stats(values) for name, values in columns.items()}
        self._write(episode, rows_table(columns), stats)
        self.episodes, self.rows = self.episodes + 1, self.rows + count

    def finish(self, info: dict[str, Any]) -> dict[str, Any]:
        """Completes all files, writes ``info.json`` and returns its content."""
        info |= {
            "total_episodes": self.episodes,
            "total_frames": self.rows,
            "total_tasks": len(self.tasks),
            "chunks_size": CHUNK,
            "fps": self.video.number,
            "data_path": self.data_path,
            "video_path": self.video_path,
            "features": self.features,
            **self._finish(),
        }
        _write_json(self.root / "meta" / "info.json", info)
        return info

    @abstractmethod
    def _write(self, episode: Episode, table: pa.Table, stats: Stats) -> None: ...

    @abstractmethod
    def _finish(self) -> dict[str, Any]:
        """Completes the files specific to a version; returns the fields of ``info.json`` specific to it."""


class LayoutV21(_Layout):
    """v2.1: a table and a video for each episode, metadata in JSON lines."""

    data_path = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    video_path = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"

    def _write(self, episode: Episode, table: pa.Table, stats: Stats) -> None:
        place = {"episode_chunk": self.episodes // CHUNK, "episode_index": self.episodes}
        data = self.root / self.data_path.format(**place)
        data.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, data)
        video = VideoFile(self.root / self.video_path.format(video_key=self.camera, **place), self.video)
        video.add(episode.rgb)
        video.close()
        row = {"episode_index": self.episodes, "tasks": [episode.task], "length": len(episode.rgb)}
        self._append("episodes", row)
        self._append("episodes_stats", {"episode_index": self.episodes, "stats": plain_stats(stats, quantiles=False)})

    def _append(self, name: str, row: dict[str, Any]) -> None:
        with (self.root / "meta" / f"{name}.jsonl").open("a") as file:
            file.write(f"{json.dumps(row)}\n")

    def _finish(self) -> dict[str, Any]:
        for task, number in self.tasks.items():
            self._append("tasks", {"task_index": number, "task": task})
        return {"total_videos": self.episodes, "total_chunks": -(-self.episodes // CHUNK)}


class LayoutV30(_Layout):
    """v3.0: tables and videos of many episodes, metadata in Parquet."""

    data_path = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    video_path = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    meta_path = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"

    def __init__(self, root: Path, video: VideoSettings, features: dict[str, dict[str, Any]]) -> None:
        super().__init__(root, video, features)
        self._data, self._meta = _Tables(root, self.data_path), _Tables(root, self.meta_path)
        self._file: VideoFile | None = None
        self._files = 0  # videos that are complete
        self._stats: Stats = {}
        self._buffer: list[dict[str, Any]] = []

    def _write(self, episode: Episode, table: pa.Table, stats: Stats) -> None:
        if self._file is not None and self._file.bytes >= VIDEO_MEGABYTES * 2**20:
            self._close_video()
        if self._file is None:
            path = self.video_path.format(video_key=self.camera, **_place(self._files))
            self._file = VideoFile(self.root / path, self.video)
        begins = self._file.frames
        self._file.add(episode.rgb)
        row: dict[str, Any] = {"episode_index": self.episodes, "tasks": [episode.task], "length": len(episode.rgb)}
        row |= {f"data/{name}": value for name, value in self._data.place().items()}
        row |= {"dataset_from_index": self.rows, "dataset_to_index": self.rows + len(episode.rgb)}
        row |= {f"videos/{self.camera}/{name}": value for name, value in _place(self._files).items()}
        row[f"videos/{self.camera}/from_timestamp"] = begins / self.video.fps
        row[f"videos/{self.camera}/to_timestamp"] = self._file.frames / self.video.fps
        for feature, values in plain_stats(stats).items():
            row |= {f"stats/{feature}/{name}": value for name, value in values.items()}
        self._data.add(table)
        self._stats = merged_stats(self._stats, stats)
        self._buffer.append(row)
        if len(self._buffer) == BUFFERED:
            self._flush()

    def _flush(self) -> None:
        place = {f"meta/episodes/{name}": value for name, value in self._meta.place().items()}
        self._meta.add(pa.Table.from_pylist([row | place for row in self._buffer]))
        self._buffer = []

    def _close_video(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file, self._files = None, self._files + 1

    def _finish(self) -> dict[str, Any]:
        if self._buffer:
            self._flush()
        for tables in (self._data, self._meta):
            tables.close()
        self._close_video()
        write_tasks(self.root / "meta" / "tasks.parquet", list(self.tasks))
        _write_json(self.root / "meta" / "stats.json", plain_stats(self._stats))
        return {"data_files_size_in_mb": DATA_MEGABYTES, "video_files_size_in_mb": VIDEO_MEGABYTES}


class _Tables:
    """Parquet files to which tables are appended; after :data:`DATA_MEGABYTES` another file begins."""

    def __init__(self, root: Path, template: str) -> None:
        self._root, self._template = root, template
        self._writer: pq.ParquetWriter | None = None
        self._number = self._bytes = 0

    def place(self) -> dict[str, int]:
        """Returns the chunk and file that the next table goes to."""
        if self._bytes and self._bytes >= DATA_MEGABYTES * 2**20:
            self.close()
            self._number, self._bytes = self._number + 1, 0
        return _place(self._number)

    def add(self, table: pa.Table) -> None:
        path = self._root / self._template.format(**self.place())
        if self._writer is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(path, table.schema)
        self._writer.write_table(table)
        self._bytes += table.nbytes

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def _place(number: int) -> dict[str, int]:
    return {"chunk_index": number // CHUNK, "file_index": number % CHUNK}


def _write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=4))
