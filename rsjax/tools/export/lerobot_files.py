"""Writes the files of a LeRobotDataset: one table and video for each episode (v2.1), or for many (v3.0).

Axes: T frames, D numbers of a column, N rows or pixels, H×W pixels.
"""

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Num, Shaped, UInt8

ENCODERS = {"av1": "libsvtav1", "h264": "libx264"}
KEY_FRAMES = 2  # frames from one key frame to the next: LeRobot's choice, as training reads frames in random order
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
COUNTERS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
OUTCOME = {"next.reward": "float32", "next.success": "bool", "next.done": "bool"}
CHUNK = 1000  # episodes (v2.1) or files (v3.0) in a folder
DATA_MEGABYTES = 100  # size after which v3.0 begins another table
VIDEO_MEGABYTES = 200  # size after which v3.0 begins another video
BUFFERED = 1000  # episodes whose metadata are written together


def video_rate(fps: float) -> Fraction:
    """Returns the nearest frame rate that a video file can state: a fraction with a denominator of at most 1001."""
    return Fraction(fps).limit_denominator(1001)


@dataclass(frozen=True)
class VideoSettings:
    """Settings of all videos of a data set: codec, constant rate factor, frames per second, pixels along each side."""

    codec: Literal["av1", "h264"]
    crf: int
    fps: float
    size: int

    @property
    def number(self) -> float:
        """Returns the frame rate as ``info.json`` states it: an int if it is a whole number."""
        if self.fps == int(self.fps):
            return int(self.fps)
        return self.fps

    def describe(self) -> dict[str, Any]:
        """Returns the ``info`` of a video feature."""
        return {
            "video.height": self.size,
            "video.width": self.size,
            "video.codec": self.codec,
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": self.number,
            "video.channels": 3,
            "has_audio": False,
        }


class VideoFile:
    """A video to which episodes are appended; :meth:`close` completes it."""

    def __init__(self, path: Path, settings: VideoSettings) -> None:
        os.environ.setdefault("SVT_LOG", "1")  # errors only
        path.parent.mkdir(parents=True, exist_ok=True)
        self.frames = 0
        self.bytes = 0
        self._container = av.open(str(path), "w", format="mp4")
        options = {"crf": str(settings.crf), "g": str(KEY_FRAMES)}
        rate = video_rate(settings.fps)
        stream: Any = self._container.add_stream(ENCODERS[settings.codec], rate=rate, options=options)
        stream.height = settings.size
        stream.width = settings.size
        stream.pix_fmt = "yuv420p"
        self._stream = stream

    def add(self, rgb: UInt8[np.ndarray, "T H W 3"]) -> None:
        """Appends frames."""
        for frame in rgb:
            self._mux(self._stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        self.frames += len(rgb)

    def close(self) -> None:
        """Writes the frames that the encoder still holds, and the file's index."""
        self._mux(self._stream.encode())
        self._container.close()

    def _mux(self, packets: Any) -> None:
        self.bytes += sum(packet.size for packet in packets)
        self._container.mux(packets)


Stats = dict[str, dict[str, np.ndarray]]  # feature → min, max, mean, std, count and quantiles


def describe_features(
    video: VideoSettings, cameras: Sequence[str], columns: Mapping[str, Sequence[str]], outcome: bool = False
) -> dict[str, dict[str, Any]]:
    """Returns the ``features`` of ``info.json``: the cameras, the columns of numbers, and row counters.

    Args:
        cameras: the names of the videos.
        columns: by name, such as "action", the names of a column's numbers.
        outcome: whether rows say what their action led to.
    """
    pictures = {"dtype": "video", "shape": [video.size, video.size, 3], "names": ["height", "width", "channels"]}
    features: dict[str, dict[str, Any]] = {name: pictures | {"info": video.describe()} for name in cameras}
    for name, names in columns.items():
        features[name] = {"dtype": "float32", "shape": [len(names)], "names": list(names)}
    single = COUNTERS
    if outcome:
        single = OUTCOME | COUNTERS
    return features | {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in single.items()}


def outcome_columns(success: Bool[np.ndarray, " T"]) -> dict[str, Shaped[np.ndarray, " T"]]:
    """Returns what each row's action led to: the success of the next frame, a reward of 1 for it, and the last row.

    The last row speaks of the last frame, since no frame follows.
    """
    reached = np.append(success[1:], success[-1])
    done = np.arange(len(success)) == len(success) - 1
    columns = {"next.reward": reached, "next.success": reached, "next.done": done}
    return {name: values.astype(OUTCOME[name]) for name, values in columns.items()}


def rows_table(columns: Mapping[str, Shaped[np.ndarray, "T ..."]]) -> pa.Table:
    """Returns columns as a table; columns with several numbers per row become lists of fixed length, as in LeRobot.

    A column with one number per row becomes scalars, even if it has two axes: that is how LeRobot reads the shape [1].
    """
    arrays: dict[str, pa.Array] = {}
    for name, values in columns.items():
        flat = pa.array(np.ascontiguousarray(values).reshape(-1))
        width = values.size // len(values)
        if width > 1:
            arrays[name] = pa.FixedSizeListArray.from_arrays(flat, width)
        else:
            arrays[name] = flat
    return pa.table(arrays)


def column_stats(values: Shaped[np.ndarray, "T ..."]) -> dict[str, np.ndarray]:
    """Returns one column's statistics over an episode, each (D,) or (1,); "std" is that of the population (1 / T)."""
    wide = values.astype(np.float64).reshape(len(values), -1)
    return _stats(wide, len(values))


def picture_stats(rgb: UInt8[np.ndarray, "T H W 3"]) -> dict[str, np.ndarray]:
    """Returns the statistics of pictures by channel, each (3, 1, 1), of values from 0 to 1; ``count`` is T."""
    pixels = rgb.reshape(-1, 3).astype(np.float64) / 255
    stats = _stats(pixels, len(rgb))
    return {name: value if name == "count" else value.reshape(3, 1, 1) for name, value in stats.items()}


def _stats(rows: Num[np.ndarray, "N D"], count: int) -> dict[str, np.ndarray]:
    quantiles = np.quantile(rows, list(QUANTILES.values()), axis=0)
    stats = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    return stats | {"count": np.array([count])} | dict(zip(QUANTILES, quantiles, strict=True))


def merged_stats(one: Stats, other: Stats) -> Stats:
    """Returns the statistics of both together; quantiles become weighted means, as in LeRobot's own aggregation."""
    if not one:
        return other
    merged: Stats = {}
    for feature, first in one.items():
        second = other[feature]
        count = first["count"] + second["count"]
        share = float(second["count"][0] / count[0])
        mixed = {name: (1 - share) * first[name] + share * second[name] for name in ("mean", *QUANTILES)}
        spread = [stats["std"] ** 2 + (stats["mean"] - mixed["mean"]) ** 2 for stats in (first, second)]
        ends = {"min": np.minimum(first["min"], second["min"]), "max": np.maximum(first["max"], second["max"])}
        std = np.sqrt((1 - share) * spread[0] + share * spread[1])
        merged[feature] = mixed | ends | {"std": std, "count": count}
    return merged


def plain_stats(stats: Stats, quantiles: bool = True) -> dict[str, Any]:
    """Returns statistics JSON-ready, on request without quantiles, which v2.1 does not have."""
    return {
        feature: {name: value.tolist() for name, value in values.items() if quantiles or name not in QUANTILES}
        for feature, values in stats.items()
    }


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Writes ``tasks.parquet`` of v3.0: a pandas frame of ``task_index`` whose index is the task's text."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": columns,
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


@dataclass(frozen=True)
class LeRobotEpisode:
    """One episode to write.

    Attributes:
        videos: the episode's frames by camera.
        columns: its numbers by name, such as ``action``, ``observation.state`` and its outcome.
        task: in words.
    """

    videos: dict[str, UInt8[np.ndarray, "T H W 3"]]
    columns: dict[str, Shaped[np.ndarray, "T ..."]]
    task: str


class _Layout(ABC):
    """The part common to both versions: counters, tasks, statistics and ``info.json``."""

    data_path: str
    video_path: str

    def __init__(self, root: Path, video: VideoSettings, features: dict[str, dict[str, Any]]) -> None:
        self.root = root
        self.video = video
        self.features = features
        self.cameras = [name for name, feature in features.items() if feature["dtype"] == "video"]
        self.episodes = 0
        self.rows = 0
        self.tasks: dict[str, int] = {}
        (root / "meta").mkdir()

    def add(self, episode: LeRobotEpisode) -> None:
        """Writes the next episode."""
        count = len(episode.videos[self.cameras[0]])
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
        stats = {camera: picture_stats(episode.videos[camera]) for camera in self.cameras}
        stats |= {name: column_stats(values) for name, values in columns.items()}
        self._write(episode, count, rows_table(columns), stats)
        self.episodes = self.episodes + 1
        self.rows = self.rows + count

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
    def _write(self, episode: LeRobotEpisode, count: int, table: pa.Table, stats: Stats) -> None: ...

    @abstractmethod
    def _finish(self) -> dict[str, Any]:
        """Completes the files specific to a version; returns the fields of ``info.json`` specific to it."""


class LayoutV21(_Layout):
    """v2.1: a table and a video for each episode, metadata in JSON lines."""

    data_path = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    video_path = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"

    def _write(self, episode: LeRobotEpisode, count: int, table: pa.Table, stats: Stats) -> None:
        place = {"episode_chunk": self.episodes // CHUNK, "episode_index": self.episodes}
        data = self.root / self.data_path.format(**place)
        data.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, data)
        for camera in self.cameras:
            video = VideoFile(self.root / self.video_path.format(video_key=camera, **place), self.video)
            video.add(episode.videos[camera])
            video.close()
        row = {"episode_index": self.episodes, "tasks": [episode.task], "length": count}
        self._append("episodes", row)
        self._append("episodes_stats", {"episode_index": self.episodes, "stats": plain_stats(stats, quantiles=False)})

    def _append(self, name: str, row: dict[str, Any]) -> None:
        with (self.root / "meta" / f"{name}.jsonl").open("a") as file:
            file.write(f"{json.dumps(row)}\n")

    def _finish(self) -> dict[str, Any]:
        for task, number in self.tasks.items():
            self._append("tasks", {"task_index": number, "task": task})
        return {"total_videos": self.episodes * len(self.cameras), "total_chunks": -(-self.episodes // CHUNK)}


class LayoutV30(_Layout):
    """v3.0: tables and videos of many episodes, metadata in Parquet."""

    data_path = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    video_path = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    meta_path = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"

    def __init__(self, root: Path, video: VideoSettings, features: dict[str, dict[str, Any]]) -> None:
        super().__init__(root, video, features)
        self._data = _Tables(root, self.data_path)
        self._meta = _Tables(root, self.meta_path)
        self._open: dict[str, VideoFile] = {}  # by camera
        self._files = 0  # videos of each camera that are complete
        self._stats: Stats = {}
        self._buffer: list[dict[str, Any]] = []

    def _write(self, episode: LeRobotEpisode, count: int, table: pa.Table, stats: Stats) -> None:
        if any(file.bytes >= VIDEO_MEGABYTES * 2**20 for file in self._open.values()):
            self._close_videos()
        row: dict[str, Any] = {"episode_index": self.episodes, "tasks": [episode.task], "length": count}
        row |= {f"data/{name}": value for name, value in self._data.place().items()}
        row |= {"dataset_from_index": self.rows, "dataset_to_index": self.rows + count}
        for camera in self.cameras:
            if camera not in self._open:
                path = self.video_path.format(video_key=camera, **_place(self._files))
                self._open[camera] = VideoFile(self.root / path, self.video)
            file = self._open[camera]
            begins = file.frames
            file.add(episode.videos[camera])
            row |= {f"videos/{camera}/{name}": value for name, value in _place(self._files).items()}
            row[f"videos/{camera}/from_timestamp"] = begins / self.video.fps
            row[f"videos/{camera}/to_timestamp"] = file.frames / self.video.fps
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

    def _close_videos(self) -> None:
        for file in self._open.values():
            file.close()
        self._open = {}
        self._files += 1

    def _finish(self) -> dict[str, Any]:
        if self._buffer:
            self._flush()
        for tables in (self._data, self._meta):
            tables.close()
        self._close_videos()
        write_tasks(self.root / "meta" / "tasks.parquet", list(self.tasks))
        _write_json(self.root / "meta" / "stats.json", plain_stats(self._stats))
        return {"data_files_size_in_mb": DATA_MEGABYTES, "video_files_size_in_mb": VIDEO_MEGABYTES}


class _Tables:
    """Parquet files to which tables are appended; after :data:`DATA_MEGABYTES` another file begins."""

    def __init__(self, root: Path, template: str) -> None:
        self._root = root
        self._template = template
        self._writer: pq.ParquetWriter | None = None
        self._number = 0
        self._bytes = 0

    def place(self) -> dict[str, int]:
        """Returns the chunk and file that the next table goes to."""
        if self._bytes and self._bytes >= DATA_MEGABYTES * 2**20:
            self.close()
            self._number = self._number + 1
            self._bytes = 0
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
