"""Reads a folder of videos with tables of actions, for your own data.

Each episode has a folder, whose name is the episode's id::

    PATH/dataset.json             optional: {"task": "fold the towel", "fps": 30, "after": false, "kind": "delta", …}
    PATH/EPISODE/CAMERA.mp4       one per camera; or a folder CAMERA/ of pictures 000000.png …
    PATH/EPISODE/CAMERA.depth/    optional: 16-bit PNG depth maps in millimetres, one per frame
    PATH/EPISODE/actions.csv      or .parquet or .npy: a row per frame
    PATH/EPISODE/episode.json     optional: {"task": …, "fps": …, "segments": [{"start", "end", "text", "skill"}]}

or, with one camera, flat: ``PATH/NAME.mp4``, ``PATH/NAME.csv`` and, optionally, ``PATH/NAME.json``.

The columns of a table have names: ``timestamp`` (seconds), ``state…``, and ``action…``; if none begins with ``action``,
all others are the action, except those that count rows or time (``time``, ``frame``, ``index`` …). A ``.npy`` array
(N, A) contains only actions. ``after`` says whether each frame was recorded after its row's action. Otherwise a row's
action leads into the next frame, and the last row may be missing. ``fps`` is needed for pictures without timestamps;
videos have their own rate.
"""

import contextlib
import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from jaxtyping import Float, Float32

from rsjax.clip import words_of
from rsjax.errors import did_you_mean
from rsjax.files import safe_id
from rsjax.tools.ingest.actions import Kind, align_actions, check_layout, layout_of
from rsjax.tools.ingest.episode import (
    LEAVE_OUT,
    MAX_FPS,
    Depths,
    Episode,
    EpisodeError,
    EpisodeRef,
    Frames,
    Segment,
    SourceError,
    checked,
    data_file,
    fingerprint,
    reason,
)
from rsjax.tools.ingest.formats.files import (
    exists,
    inside,
    load_npy,
    location_of,
    matrix,
    media,
    parquet_columns,
    read_json,
    seconds,
    subfolders,
)
from rsjax.tools.ingest.formats.options import from_json
from rsjax.tools.ingest.pictures import PictureFiles
from rsjax.tools.ingest.video import VideoFrames, scan

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


@dataclass(frozen=True)
class FolderConfig:
    """The settings of ``dataset.json`` and the options, for all episodes.

    Attributes:
        task: the task of episodes that name none; None (null in JSON) means no task.
        fps: frames per second; 0: as the videos or the timestamps say.
        after: whether each frame was recorded after the action of its row.
        action: the columns that are the action, in order; none: by their names.
        kind: see :class:`rsjax.tools.ingest.actions.ActionLayout`; None: not declared, so rows of actions are not
            combined.
        held: likewise.
        quaternions: likewise.
        angles: likewise.
    """

    task: str | None = ""
    fps: float = 0.0
    after: bool = False
    action: tuple[str, ...] = ()
    kind: Kind | None = None
    held: tuple[int, ...] | None = None
    quaternions: tuple[int, ...] = ()
    angles: tuple[int, ...] = ()


def open_source(
    path: Path,
    *,
    task: str | None = None,
    fps: float | None = None,
    after: bool | None = None,
    action: Sequence[str] | None = None,
    kind: Kind | None = None,
    held: Sequence[int] | None = None,
    quaternions: Sequence[int] | None = None,
    angles: Sequence[int] | None = None,
) -> "Folder":
    """Opens the data set at ``path``; options as in :class:`FolderConfig`, None: as ``dataset.json`` says.

    Raises:
        SourceError: ``dataset.json`` or an option is wrong, or ``path`` is not a folder.
    """
    if not path.is_dir():
        raise SourceError(f"{path}: not a folder; give the one that contains the episodes")
    file = path / "dataset.json"
    if exists(file):
        values = read_json(file)
    else:
        values = {}
    from_json(FolderConfig, values, file)
    options: dict[str, object] = {"task": task, "fps": fps, "after": after, "action": action}
    options |= {"kind": kind, "held": held, "quaternions": quaternions, "angles": angles}
    config = from_json(FolderConfig, values | {k: v for k, v in options.items() if v is not None}, path)
    if not 0 <= config.fps <= MAX_FPS:
        raise SourceError(f"{path}: fps is {config.fps!r}, should be a number from 0 to {MAX_FPS:g}; mend it")
    return Folder(path, config)


class Folder:
    """A folder of videos, as :class:`rsjax.tools.ingest.episode.EpisodeSource`; :func:`open_source` builds it."""

    name = "folder"

    def __init__(self, root: Path, config: FolderConfig) -> None:
        self._root = root
        self._config = config

    def episodes(self) -> Iterator[EpisodeRef]:
        """Lists folders first, then the files that make up flat episodes, each by name."""
        folders = subfolders(self._root)
        flat = 0
        for folder in folders:
            yield self._ref(folder.name, flat=False)
        by_name: dict[str, list[Path]] = {}
        for path in self._root.iterdir():
            if path.suffix.lower() in (*VIDEOS, *TABLES, ".json"):
                by_name.setdefault(path.stem, []).append(path)
        for name, files in sorted(by_name.items()):
            if any(path.suffix.lower() != ".json" for path in files):
                flat += 1
                yield self._ref(name, flat=True, files=sorted(files))
        if not folders and not flat:
            raise SourceError(f"{self._root}: has no episode: no folder, video or table; give the one that does")

    def read(self, ref: EpisodeRef) -> Episode:
        """Reads one episode."""
        location = location_of(ref)
        place = inside(self._root, location["name"])
        try:
            return self._read(ref, location["name"], location["flat"], place)
        except OSError as error:
            raise EpisodeError.at(place, f"cannot be read ({error.strerror})", "check its permissions") from error

    def _read(self, ref: EpisodeRef, name: str, flat: bool, place: Path) -> Episode:
        config = self._config
        files = self._files(name, flat)
        cameras, depth = find_cameras(files, flat)
        table_path = find_table(files, place)
        if not cameras:
            problem = f"has no video ({', '.join(VIDEOS)}) and no folder of pictures"
            raise EpisodeError.at(place, problem, "add one or leave it out")
        count = len(next(iter(cameras.values())))
        if flat:
            json_path = place.with_name(f"{name}.json")
        else:
            json_path = place / "episode.json"
        task, own_fps, segments = read_description(json_path, count)
        table = read_table(table_path)
        fps = own_fps or config.fps
        chosen, others = choose_columns(table, config.action, table_path)
        actions, names = columns(table, chosen, table_path)
        times = _times(table, cameras, fps, count, place)
        if len(times) != count:
            problem = f"{len(times)} timestamps for {count} pictures"
            raise EpisodeError.at(table_path, problem, "one row per frame", "length")
        if not config.after and len(actions) == count - 1:  # the last row leads into no frame
            actions = np.concatenate([actions, actions[-1:]])
        if len(actions) != count:
            problem = f"{len(actions)} rows of actions for {count} pictures"
            raise EpisodeError.at(table_path, problem, "one row per frame", "length")
        actions = align_actions(actions, config.after)
        if not fps:
            interval = float(np.median(np.diff(times))) if count > 1 else 1.0
            fps = 1 / interval if interval > 0 else 1.0  # time may stand still
        measured = [column for column in table.column_names if column.startswith("state")]
        states = None
        if measured:
            states = columns(table, measured, table_path)[0]
        layout = layout_of(actions, config.kind, config.held, config.quaternions, config.angles, names, states)
        check_layout(layout, actions.shape[1], table_path)
        episode = Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task=task or words_of(config.task),
            fps=fps,
            timestamps=times - times[0],
            actions=actions,
            states=states,
            cameras=cameras,
            depth=depth,
            segments=segments,
            meta={
                "actions": layout.to_json(),
                "action_names": names,
                "notes": {"not_taken_for_actions": others} if others else {},
            },
        )
        return checked(episode, table_path)

    def _files(self, name: str, flat: bool) -> list[Path]:
        """Returns the files of an episode, judged by their names."""
        try:
            if flat:
                return sorted(path for path in self._root.iterdir() if path.stem == name and not path.is_dir())
            return sorted(path for path in (self._root / name).iterdir() if not path.name.startswith("."))
        except OSError as error:
            raise EpisodeError.at(self._root / name, f"cannot be listed ({error.strerror})", "leave it out") from error

    def _ref(self, name: str, flat: bool, files: Sequence[Path] | None = None) -> EpisodeRef:
        sizes = []
        try:
            if files is None:
                files = self._files(name, flat)
            for folder in filter(Path.is_dir, files):  # pictures are too many to open
                sizes += sorted((folder.name, path.name, path.stat().st_size) for path in folder.iterdir())
        except (EpisodeError, OSError):
            files = []  # reading the episode reports why
        config = dataclasses.asdict(self._config)
        if not self._config.angles:  # so that the fingerprints of data sets without angles stay as they were
            del config["angles"]
        identity = safe_id(f"{name}.flat" if flat and (self._root / name).is_dir() else name)
        return EpisodeRef(identity, fingerprint(files, name, sizes, config), {"name": name, "flat": flat})


def _times(
    table: pa.Table, cameras: Mapping[str, Frames], fps: float, count: int, place: Path
) -> Float[np.ndarray, " N"]:
    """Returns times from the table, else by the given rate, else from the videos, whose clocks must agree."""
    if "timestamp" in table.column_names:
        return seconds(table, "timestamp", place)
    if fps:
        return np.arange(count) / fps
    clocks = {name: scan(f.path).times() for name, f in cameras.items() if isinstance(f, VideoFrames)}
    for name, times in clocks.items():
        first, own = next(iter(clocks.items()))
        if len(times) == len(own):
            apart = np.abs((times - times[0]) - (own - own[0]))
        else:
            apart = np.zeros(1)
        if apart.max() > np.diff(own).max(initial=1e-3):
            problem = f"its frame {int(apart.argmax())} is shown {apart.max():.2g} s away from that of {first}"
            raise EpisodeError.at(place / name, problem, "give timestamps in the table, or fps", "time")
    if clocks:
        return next(iter(clocks.values()))
    raise EpisodeError(f"{place}: how fast are its pictures? Give fps in dataset.json or timestamps")


def read_description(path: Path, count: int) -> tuple[str, float, tuple[Segment, ...]]:
    """Reads task, rate and segments of an episode's JSON, if there is one; "" and 0 if it does not name them.

    Args:
        count: the episode's number of frames.

    Raises:
        EpisodeError: the file is damaged, a field is wrong, or a segment is not within the frames.
    """
    try:
        if exists(path):
            values = read_json(path)
        else:
            values = {}
        fps = float(values.get("fps") or 0)
        task = values.get("task")
        if not 0 <= fps <= MAX_FPS or not isinstance(task, str | None):
            raise ValueError(f"fps {fps}, task {task!r}")
        segments = []
        for place, entry in enumerate(values.get("segments") or ()):
            try:
                segment = Segment(
                    int(entry["start"]), int(entry["end"]), words_of(entry["text"]), words_of(entry.get("skill"))
                )
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                raise EpisodeError.at(path, f"segment {place}: field missing or wrong ({error})", "mend it") from error
            if not 0 <= segment.start < segment.end <= count:
                problem = f"segment {place} is {segment.start} … {segment.end}, there are {count} frames"
                raise EpisodeError.at(path, problem, "mend it")
            segments.append(segment)
    except SourceError as error:
        raise EpisodeError(str(error)) from error
    except (AttributeError, TypeError, ValueError) as error:
        raise EpisodeError.at(path, f"task, fps or segments are wrong ({error})", "mend the file") from error
    return words_of(task), fps, tuple(sorted(segments, key=lambda segment: segment.start))


def find_cameras(files: Sequence[Path], flat: bool) -> tuple[dict[str, Frames], dict[str, Depths]]:
    """Returns pictures and depth maps by camera; the camera of a flat episode is called ``main``."""
    cameras: dict[str, Frames] = {}
    depth: dict[str, Depths] = {}
    frames: Frames
    for path in files:
        if path.suffix.lower() in VIDEOS:
            if flat:
                name = "main"
            else:
                name = path.stem
            frames = VideoFrames(media(path))
        elif path.is_dir() and path.suffix == _DEPTH:
            depth[path.stem] = PictureFiles(_pictures(path, (".png",)), depth=True)
            continue
        elif path.is_dir() and (pictures := _pictures(path, PICTURES)):
            name = path.name
            frames = PictureFiles(pictures)
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
    numbers = 0  # among the names, if the file has no line of names
    for name in names:
        with contextlib.suppress(ValueError):
            float(name)
            numbers += 1
    if len(set(names)) < len(names) or numbers == len(names):
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
        if width == 1:
            dimensions += [name]
        else:
            dimensions += [f"{name}[{place}]" for place in range(width)]
    return np.concatenate([*parts.values()], 1), dimensions


def _pictures(folder: Path, endings: Sequence[str]) -> list[Path]:
    try:
        paths = [media(path) for path in folder.iterdir() if path.suffix.lower() in endings]
    except OSError as error:
        raise EpisodeError.at(folder, f"cannot be listed ({error.strerror})", LEAVE_OUT) from error
    return sorted(paths, key=lambda path: (len(path.name), path.name))
