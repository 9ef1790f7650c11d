"""The files of one episode in a folder of videos: its cameras, its table, what its JSON tells."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from jaxtyping import Float32

from rsjax.ingest.episode import MAX_FPS, Depths, EpisodeError, Frames, Segment, SourceError, plain
from rsjax.ingest.formats.files import is_there, load_npy, matrix, media, parquet_columns, read_json
from rsjax.ingest.pictures import DepthFiles, PictureFiles
from rsjax.ingest.video import VideoFrames

VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm")
PICTURES = (".png", ".jpg", ".jpeg")
TABLES = (".csv", ".parquet", ".npy")
_DEPTH = ".depth"
_MOST_BYTES = 2**28  # of a table that is text


@dataclass(frozen=True)
class Told:
    """What an episode's JSON says; nothing where there is none.

    Attributes:
        path: of the JSON.
        task: None: not named.
        fps: 0: not named.
        entries: its segments.
    """

    path: Path
    task: str | None = None
    fps: float = 0.0
    entries: tuple[Any, ...] = ()

    @classmethod
    def read(cls, path: Path) -> "Told":
        """Raises :class:`EpisodeError` where the file is damaged or a field is wrong."""
        try:
            if not is_there(path):
                return cls(path)
            values = read_json(path)
        except SourceError as error:
            raise EpisodeError(str(error)) from error
        try:
            fps, task = float(values.get("fps") or 0), values.get("task")
            if not 0 <= fps <= MAX_FPS or not isinstance(task, str | None):
                raise ValueError(f"fps {fps}, task {task!r}")
            return cls(path, task, fps, tuple(values.get("segments") or ()))
        except (AttributeError, TypeError, ValueError) as error:
            raise EpisodeError(f"{path}: task, fps or segments are wrong ({error}); mend the file") from error

    def segments(self, count: int) -> tuple[Segment, ...]:
        """In the order of their starts; raises :class:`EpisodeError` for one that is not within ``count`` frames."""
        made = []
        for place, entry in enumerate(self.entries):
            try:
                segment = Segment(
                    int(entry["start"]), int(entry["end"]), str(entry["text"]), str(entry.get("skill") or "")
                )
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                raise EpisodeError(
                    f"{self.path}: segment {place}: field missing or wrong ({error}); mend it"
                ) from error
            if not 0 <= segment.start < segment.end <= count:
                ends = f"{segment.start} … {segment.end}"
                raise EpisodeError(f"{self.path}: segment {place} is {ends}, there are {count} frames; mend it")
            made.append(segment)
        return tuple(sorted(made, key=lambda segment: segment.start))


def cameras_of(files: Sequence[Path], flat: bool) -> tuple[dict[str, Frames], dict[str, Depths]]:
    """Pictures and depth maps by camera; the camera of a flat episode is called ``main``."""
    cameras: dict[str, Frames] = {}
    depth: dict[str, Depths] = {}
    for path in files:
        if path.suffix.lower() in VIDEOS:
            name = "main" if flat else path.stem
            if name in cameras:
                raise EpisodeError(f"{path}: a second camera {name!r}; rename or remove one")
            cameras[name] = VideoFrames(media(path))
        elif path.is_dir() and path.suffix == _DEPTH:
            depth[path.stem] = DepthFiles(_pictures(path, (".png",)))
        elif path.is_dir() and (pictures := _pictures(path, PICTURES)):
            if path.name in cameras:
                raise EpisodeError(f"{path}: a second camera {path.name!r}; rename or remove one")
            cameras[path.name] = PictureFiles(pictures)
    for name in depth:
        if name not in cameras:
            raise EpisodeError(f"{files[0].parent / name}{_DEPTH}: depth of a camera that is not there; rename it")
    return cameras, depth


def one_table(files: Sequence[Path], place: Path) -> Path:
    """The episode's table; raises :class:`EpisodeError` where there is none, or more than one."""
    tables = [path for path in files if path.suffix.lower() in TABLES]
    if len(tables) != 1:
        names = ", ".join(path.name for path in tables) or "none"
        raise EpisodeError(f"{place}: needs one table of actions ({', '.join(TABLES)}), there is {names}")
    return tables[0]


def read_table(path: Path) -> pa.Table:
    """The table, with a column ``action`` of lists for a ``.npy``.

    Raises:
        EpisodeError: it is damaged, or its columns have no names.
    """
    if path.suffix.lower() == ".npy":
        array = load_npy(path)
        if array.ndim != 2 or not array.size:
            raise EpisodeError(f"{path}: shape {array.shape}, should be (frames, action dimensions); save it again")
        return pa.table({"action": array.astype(np.float32).tolist()})
    if path.suffix.lower() == ".parquet":
        return parquet_columns(path)
    try:
        if (size := path.stat().st_size) > _MOST_BYTES:
            raise ValueError(f"{size} bytes are more than an episode's table can have")
        with plain(path).open("rb") as file:
            table = pa_csv.read_csv(file)
        names = table.column_names  # decoded here, not before
    except (pa.ArrowException, OSError, ValueError) as error:
        raise EpisodeError(f"{path}: cannot be read ({' '.join(str(error).split())[:200]}); save it again") from error
    if len(set(names)) < len(names) or all(map(_is_number, names)):
        raise EpisodeError(f"{path}: its first line must name the columns, each once; it has {names}")
    return table


def action_columns(table: pa.Table) -> list[str]:
    """Those that begin with ``action``; where none does, all but time and states."""
    named = [name for name in table.column_names if name.startswith("action")]
    return named or [name for name in table.column_names if name != "timestamp" and not name.startswith("state")]


def state_columns(table: pa.Table) -> list[str]:
    """Those that begin with ``state``."""
    return [name for name in table.column_names if name.startswith("state")]


def columns(table: pa.Table, names: Sequence[str], path: Path) -> Float32[np.ndarray, "N A"]:
    """These columns side by side; raises :class:`EpisodeError` where there are none or they are not numbers."""
    if not names:
        raise EpisodeError(f"{path}: has no column of actions; it has {', '.join(table.column_names)}")
    return np.concatenate([matrix(table, name, path) for name in names], 1)


def _pictures(folder: Path, endings: Sequence[str]) -> list[Path]:
    try:
        found = [media(path) for path in folder.iterdir() if path.suffix.lower() in endings]
    except OSError as error:
        raise EpisodeError(f"{folder}: cannot be listed ({error.strerror}); leave the episode out") from error
    return sorted(found, key=lambda path: (len(path.name), path.name))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
