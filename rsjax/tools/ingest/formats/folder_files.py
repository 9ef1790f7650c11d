"""Reads the files of one episode in a folder of videos: its cameras, its table and its JSON."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from jaxtyping import Float32

from rsjax.clip import words_of
from rsjax.errors import did_you_mean
from rsjax.tools.ingest.episode import (
    LEAVE_OUT,
    MAX_FPS,
    Depths,
    EpisodeError,
    Frames,
    Segment,
    SourceError,
    data_file,
    reason,
)
from rsjax.tools.ingest.formats.files import exists, load_npy, matrix, media, parquet_columns, read_json
from rsjax.tools.ingest.pictures import PictureFiles
from rsjax.tools.ingest.video import VideoFrames

VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm")
PICTURES = (".png", ".jpg", ".jpeg")
TABLES = (".csv", ".parquet", ".npy")
_DEPTH = ".depth"
# Columns that count rows or time, including the names of columns that pandas adds.
_COUNTING = re.compile(
    r"|unnamed: \d+|((time|frame|row|step|episode|task)[ _]?)?(index|idx|id|number|count)|__index_level_\d+__"
    r"|time([ _]?(stamps?|s|sec|seconds|ms|ns))?|t|frames?|rows?|steps?|seconds|sec|stamps?"
)
_MOST_BYTES = 2**28  # largest size of a text table


def read_description(path: Path, count: int) -> tuple[str, float, tuple[Segment, ...]]:
    """Reads task, rate and segments of an episode's JSON, if there is one; "" and 0 if it does not name them.

    Args:
        count: the episode's number of frames.

    Raises:
        EpisodeError: the file is damaged, a field is wrong, or a segment is not within the frames.
    """
    try:
        values = read_json(path) if exists(path) else {}
        fps, task = float(values.get("fps") or 0), values.get("task")
        if not 0 <= fps <= MAX_FPS or not isinstance(task, str | None):
            raise ValueError(f"fps {fps}, task {task!r}")
        segments = [_segment(path, place, entry, count) for place, entry in enumerate(values.get("segments") or ())]
    except SourceError as error:
        raise EpisodeError(str(error)) from error
    except (AttributeError, TypeError, ValueError) as error:
        raise EpisodeError.at(path, f"task, fps or segments are wrong ({error})", "mend the file") from error
    return words_of(task), fps, tuple(sorted(segments, key=lambda segment: segment.start))


def _segment(path: Path, place: int, entry: Any, count: int) -> Segment:
    try:
        segment = Segment(int(entry["start"]), int(entry["end"]), words_of(entry["text"]), words_of(entry.get("skill")))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise EpisodeError.at(path, f"segment {place}: field missing or wrong ({error})", "mend it") from error
    if not 0 <= segment.start < segment.end <= count:
        problem = f"segment {place} is {segment.start} … {segment.end}, there are {count} frames"
        raise EpisodeError.at(path, problem, "mend it")
    return segment


def find_cameras(files: Sequence[Path], flat: bool) -> tuple[dict[str, Frames], dict[str, Depths]]:
    """Returns pictures and depth maps by camera; the camera of a flat episode is called ``main``."""
    cameras: dict[str, Frames] = {}
    depth: dict[str, Depths] = {}
    frames: Frames
    for path in files:
        if path.suffix.lower() in VIDEOS:
            name, frames = "main" if flat else path.stem, VideoFrames(media(path))
        elif path.is_dir() and path.suffix == _DEPTH:
            depth[path.stem] = PictureFiles(_pictures(path, (".png",)), depth=True)
            continue
        elif path.is_dir() and (pictures := _pictures(path, PICTURES)):
            name, frames = path.name, PictureFiles(pictures)
        else:
            continue
        if name in cameras:
            raise EpisodeError.at(path, f"a second camera {name!r}", "rename or remove one")
        cameras[name] = frames
    for name in depth:
        if name not in cameras:
            where = f"{files[0].parent / name}{_DEPTH}"
            raise EpisodeError.at(where, "depth of a camera that is not there", "rename it")
    return cameras, depth


def find_table(files: Sequence[Path], place: Path) -> Path:
    """Returns the episode's table; raises :class:`EpisodeError` if there is none, or more than one."""
    tables = [path for path in files if path.suffix.lower() in TABLES]
    if len(tables) != 1:
        names = ", ".join(path.name for path in tables) or "none"
        raise EpisodeError(f"{place}: needs one table of actions ({', '.join(TABLES)}), there is {names}")
    return tables[0]


def read_table(path: Path) -> pa.Table:
    """Reads the table; a ``.npy`` becomes a column ``action`` of lists.

    Raises:
        EpisodeError: the table is damaged, or its columns have no names.
    """
    if path.suffix.lower() == ".npy":
        array = load_npy(path)
        if array.ndim != 2 or not array.size:
            raise EpisodeError.at(path, f"shape {array.shape}, should be (frames, action dimensions)", "save it again")
        return pa.table({"action": array.astype(np.float32).tolist()})
    if path.suffix.lower() == ".parquet":
        return parquet_columns(path)
    try:
        if (size := path.stat().st_size) > _MOST_BYTES:
            raise ValueError(f"{size} bytes are more than an episode's table can have")
        with data_file(path).open("rb") as file:
            table = pa_csv.read_csv(file)
        names = table.column_names  # names are decoded only here
    except (pa.ArrowException, OSError, ValueError) as error:
        raise EpisodeError.at(path, reason(error), "save it again") from error
    if len(set(names)) < len(names) or all(map(_is_number, names)):
        raise EpisodeError(f"{path}: its first line must name the columns, each once; it has {names}")
    return table


def choose_columns(table: pa.Table, asked: Sequence[str], path: Path) -> tuple[list[str], list[str]]:
    """Returns the columns that are the action, and those that are not because they only count rows or time.

    Args:
        asked: the columns that a user names; none: those that begin with ``action``, or else all that are left.

    Raises:
        EpisodeError: there is no such column.
    """
    there = table.column_names
    if absent := [name for name in asked if name not in there]:
        hint = did_you_mean(absent[0], there)
        message = f"{path}: has no column {absent[0]!r}{hint}; it has {', '.join(there)}"
        raise EpisodeError(message, option="--option action")
    actions = list(asked) or [name for name in there if name.startswith("action")]
    if actions:
        return actions, []
    left = [name for name in there if name != "timestamp" and not name.startswith("state")]
    counting = [name for name in left if _COUNTING.fullmatch(name.lower())]
    actions = [name for name in left if name not in counting]
    if not actions:
        raise EpisodeError(f"{path}: has no column of actions; it has {', '.join(there)}")
    return actions, counting


def columns(table: pa.Table, names: Sequence[str], path: Path) -> tuple[Float32[np.ndarray, "N A"], list[str]]:
    """Returns columns side by side and a name per dimension; :class:`EpisodeError` if they are not numbers."""
    parts = {name: matrix(table, name, path) for name in names}
    dimensions: list[str] = []
    for name, part in parts.items():
        width = part.shape[1]
        dimensions += [name] if width == 1 else [f"{name}[{place}]" for place in range(width)]
    return np.concatenate([*parts.values()], 1), dimensions


def _pictures(folder: Path, endings: Sequence[str]) -> list[Path]:
    try:
        paths = [media(path) for path in folder.iterdir() if path.suffix.lower() in endings]
    except OSError as error:
        raise EpisodeError.at(folder, f"cannot be listed ({error.strerror})", LEAVE_OUT) from error
    return sorted(paths, key=lambda path: (len(path.name), path.name))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
