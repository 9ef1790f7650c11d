"""Reads LeRobotDataset v2.0, v2.1 and v3.0 without the ``lerobot`` package: tables by pyarrow, videos by PyAV.

A row's action is sent at that row's frame, so it leads into the next frame. v2 has a table for each episode, and a
video for each episode and camera; in v3 many episodes share a file, and an episode's pictures are looked up by time.
"""

import bisect
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float, UInt8

from rsjax.clip import GENERATED, words_of
from rsjax.files import safe_id
from rsjax.tools.ingest.actions import ActionLayout, Declared, Kind, align_actions, check_layout, flat_names, layout_of
from rsjax.tools.ingest.episode import (
    FETCH_AGAIN,
    MAX_FPS,
    Episode,
    EpisodeError,
    EpisodeRef,
    Frames,
    SourceError,
    checked,
    fingerprint,
    runs,
)
from rsjax.tools.ingest.formats.files import (
    broken,
    exists,
    fill,
    inside,
    integers,
    json_lines,
    location_of,
    matrix,
    media,
    parquet_columns,
    parquet_rows,
    read_json,
    seconds,
)
from rsjax.tools.ingest.pictures import decode_pictures
from rsjax.tools.ingest.video import at_times

TOLERANCE = 1e-4  # seconds, LeRobot's own tolerance
EXPORTED = "rsjax.json"  # in meta, of a data set that rsjax export wrote
PROVENANCE = "provenance.json"  # in meta, where LeRobot reads no such file: which episodes a world model generated
OUTCOME = ("next.reward", "next.success", "next.done")
_PLACES = ("chunk_index", "file_index")
_BEGINS = "from_timestamp"
_ALL = [("episode_index", ">=", 0)]  # a shared file may have more rows than the limit for one episode


def open_source(
    path: Path,
    *,
    action: str = "action",
    state: str = "observation.state",
    kind: Kind | None = None,
    held: Sequence[int] | None = None,
    quaternions: Sequence[int] = (),
    angles: Sequence[int] = (),
) -> "LeRobot":
    """Opens the data set at ``path``, the folder that contains ``meta``.

    Args:
        action: the column of actions.
        state: the column of states; if it is missing, episodes have none.
        kind: what the actions are, which the format does not say; see
            :class:`rsjax.tools.ingest.actions.ActionLayout`. None: not declared, so rows of actions are not combined.
        held: likewise.
        quaternions: likewise.
        angles: likewise.

    Raises:
        SourceError: ``meta`` cannot be read, or there is no such column of actions.
    """
    info = read_info(path / "meta" / "info.json")
    if action not in info.features:
        raise SourceError(f"{path}: has no column {action!r}; choose among {', '.join(info.features)}")
    tasks = _tasks(path / "meta", info.shared)
    exported = exists(path / "meta" / EXPORTED)
    generated = _generated(path / "meta" / PROVENANCE)
    if held is None:
        stay = None
    else:
        stay = tuple(held)
    declared = Declared(kind, stay, tuple(quaternions))
    turning = tuple(angles)
    recordings: tuple[str, ...] = ()
    if exported:
        recordings, meaning, turned = _about(path / "meta" / EXPORTED)
        if meaning and (*declared, turning) == (None, None, (), ()):
            declared = meaning
            turning = turned
    return LeRobot(path, info, tasks, declared, action, state, exported, generated, recordings, turning)


def _about(path: Path) -> tuple[tuple[str, ...], Declared | None, tuple[int, ...]]:
    """Returns of which recording each exported clip is, what the actions are if the file says so, and their angles."""
    about = read_json(path)
    try:
        recordings = tuple(map(str, about.get("recordings") or ()))
        if "actions" not in about:
            return recordings, None, ()
        layout = ActionLayout.from_json(about["actions"])
        if layout.kind not in ("absolute", "delta") or not all(
            isinstance(number, int) for number in layout.held + layout.quaternions + layout.angles
        ):
            raise ValueError(f"actions are {about['actions']!r:.80}")
    except (AttributeError, TypeError, ValueError) as error:
        raise SourceError(f"{path}: field missing or wrong ({error}); export the store again") from error
    return recordings, Declared(layout.kind, layout.held, layout.quaternions), layout.angles


@dataclass(frozen=True)
class Info:
    """The part of ``meta/info.json`` that reading needs.

    Attributes:
        shared: whether episodes share files (v3).
        fps: frames per second.
        chunks_size: episodes per folder (v2).
        data_path: template of a table's path.
        video_path: template of a video's path, "" without videos.
        features: column → ``dtype``, ``shape``, ``names``.
        episodes: number of episodes that there should be; 0 if the file does not say.
    """

    shared: bool
    fps: float
    chunks_size: int
    data_path: str
    video_path: str
    features: dict[str, dict[str, Any]]
    episodes: int = 0

    def of_type(self, dtype: str) -> list[str]:
        """Returns the camera columns of a dtype (``video`` or ``image``), without coloured depth."""
        keys = []
        for key, feature in self.features.items():
            details = feature.get("info") or feature.get("video_info")
            is_depth = isinstance(details, dict) and details.get("video.is_depth_map")
            if feature.get("dtype") == dtype and not is_depth and "depth" not in key.rpartition(".")[2]:
                keys.append(key)
        return keys


def read_info(path: Path) -> Info:
    """Reads ``meta/info.json``; :class:`SourceError` if a field is missing or of an unknown version."""
    if not exists(path):
        raise SourceError(f"{path}: missing; fetch the file again, or give the folder that has meta/")
    values = read_json(path)
    try:
        version = str(values["codebase_version"])
        if not version.startswith(("v2.", "v3.")):
            raise SourceError(f"{path}: codebase_version {version}; v2.0, v2.1 and v3.0 can be read: convert it")
        info = Info(
            shared=version.startswith("v3."),
            fps=float(values["fps"]),
            chunks_size=int(values.get("chunks_size", 1000)),
            data_path=str(values["data_path"]),
            video_path=str(values.get("video_path") or ""),
            features=dict(values["features"]),
            episodes=int(values.get("total_episodes") or 0),
        )
        if not 0 < info.fps <= MAX_FPS or info.chunks_size <= 0:
            raise ValueError(f"fps {info.fps}, chunks_size {info.chunks_size}")
        if not all(isinstance(feature, dict) for feature in info.features.values()):
            raise ValueError("features are not all objects")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise SourceError(f"{path}: field missing or wrong ({error}); fetch the file again") from error
    return info


class LeRobot:
    """A LeRobotDataset, as :class:`rsjax.tools.ingest.episode.EpisodeSource`; :func:`open_source` builds it."""

    name = "lerobot"

    def __init__(
        self,
        root: Path,
        info: Info,
        tasks: dict[int, str],
        declared: Declared,
        action: str,
        state: str,
        exported: bool = False,
        generated: frozenset[int] = frozenset(),
        recordings: tuple[str, ...] = (),
        angles: tuple[int, ...] = (),
    ) -> None:
        self._root = root
        self._info = info
        self._tasks = tasks
        self._declared = declared
        self._action = action
        self._state = state
        self._exported = exported  # by this project, which writes clips: each is one shot
        self._generated = generated
        self._recordings = recordings  # which recording each clip is of
        self._angles = angles
        self._known = fingerprint((), sorted(tasks.items()))

    def episodes(self) -> Iterator[EpisodeRef]:
        """Lists ``meta/episodes``; a bad or repeated entry becomes a reference that cannot be read."""
        seen: set[int] = set()
        listed = 0
        for where, row in self._entries():
            listed += 1
            try:
                if isinstance(row, Exception):
                    raise row
                number = int(row["episode_index"])
                if number in seen:
                    raise ValueError(f"episode {number} a second time")
                seen.add(number)
                yield self._ref(number, row)
            except EpisodeError as error:
                yield broken(f"episode_{number:06d}", str(error))
            except SourceError as error:
                yield broken(safe_id(where), str(error))
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                identity = where.rpartition("/")[2].replace(" ", "-").replace(":", "-")
                yield broken(identity, f"{where}: field missing or wrong ({error}); {FETCH_AGAIN}")
        if listed < self._info.episodes:
            problem = f"total_episodes is {self._info.episodes}, meta lists only {listed}"
            yield broken("meta-info", f"{self._root}/meta/info.json: {problem}; {FETCH_AGAIN}")

    def read(self, ref: EpisodeRef) -> Episode:
        """Reads one episode; its pictures are not decoded, but their times are checked."""
        location = location_of(ref)
        counters = ("timestamp", "frame_index", "episode_index", "index", "task_index")
        names = (*counters, self._action, self._state, *OUTCOME)
        path, table = read_rows(self._root, self._info.data_path, location, names)
        times = seconds(table, "timestamp", path)
        notes = self._check_rows(table, times, location, path)
        actions = matrix(table, self._action, path)
        dimensions = flat_names(self._info.features[self._action].get("names"), actions.shape[1])
        if self._state in table.column_names:
            states = matrix(table, self._state, path)
        else:
            states = None
        layout = layout_of(align_actions(actions), *self._declared, self._angles, dimensions, states)
        check_layout(layout, actions.shape[1], path)
        tasks: list[str] = []
        if "task_index" in table.column_names and self._tasks:
            indices = integers(table, "task_index", path).tolist()
            if unknown := set(indices) - set(self._tasks):
                raise EpisodeError.at(path, f"task_index {min(unknown)} is not among the data set's tasks")
            tasks = [self._tasks[index] for index in indices]
        meta: dict[str, Any] = {"actions": layout.to_json(), "action_names": dimensions}
        meta |= _outcome(table, path, notes)
        if self._exported:
            meta["one_shot"] = True
        if location.get("generated"):
            meta["source"] = GENERATED
        if notes:
            meta["notes"] = notes
        cameras: dict[str, Frames] = {}
        for key, video in location["videos"].items():
            file = media(inside(self._root, video["path"]))
            cameras[_camera(key)] = at_times(file, times + video["from"], _tolerance(times))
        for key in self._info.of_type("image"):
            cameras[_camera(key)] = TablePictures(path, key, location)
        episode = Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task=tasks[0] if len(set(tasks)) == 1 else "; ".join(location["tasks"]),
            fps=self._info.fps,
            timestamps=times - times[0],
            actions=align_actions(actions),
            states=states,
            cameras=cameras,
            segments=tuple(runs(tasks)) if len(set(tasks)) > 1 else (),
            meta=meta,
        )
        return checked(episode, path)

    def _entries(self) -> Iterator[tuple[str, Any]]:
        """Yields where each episode's metadata are, and the metadata or the error if they cannot be read."""
        meta = self._root / "meta"
        if not self._info.shared:
            path = meta / "episodes.jsonl"
            yield from ((f"{path}: line {number}", row) for number, row in json_lines(path))
            return
        columns = ["episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index"]
        columns += [f"data/{name}" for name in _PLACES]
        columns += [f"videos/{key}/{name}" for key in self._info.of_type("video") for name in (*_PLACES, _BEGINS)]
        files = sorted((meta / "episodes").glob("*/*.parquet"))
        if not files:
            raise SourceError(f"{meta / 'episodes'}: has no Parquet files; fetch the data set again")
        for path in files:
            try:
                yield from ((f"{path}: row {number}", row) for number, row in enumerate(parquet_rows(path, columns)))
            except SourceError as error:  # the episodes of other files can still be read
                yield str(path.relative_to(meta)), error

    def _ref(self, number: int, row: dict[str, Any]) -> EpisodeRef:
        info = self._info
        length = int(row["length"])
        if number < 0 or length < 0:
            raise ValueError(f"episode_index {number}, length {length}")

        def fields(prefix: str) -> dict[str, int]:
            if not info.shared:
                return {"episode_chunk": number // info.chunks_size, "episode_index": number}
            return {name: int(row[f"{prefix}/{name}"]) for name in _PLACES}

        location: dict[str, Any] = {"episode": number, "length": length}
        location["tasks"] = [text for task in row.get("tasks") or () if (text := words_of(task))]
        if number in self._generated:
            location["generated"] = True
        location["data"] = fill(info.data_path, **fields("data"))
        if info.shared:
            location["rows"] = [int(row["dataset_from_index"]), int(row["dataset_to_index"])]
        location["videos"] = {
            key: {
                "path": fill(info.video_path, video_key=key, **fields(f"videos/{key}")),
                "from": float(row[f"videos/{key}/{_BEGINS}"]) if info.shared else 0.0,
            }
            for key in info.of_type("video")
        }
        if number < len(self._recordings):
            location["recording"] = self._recordings[number]
        paths = [location["data"], *(video["path"] for video in location["videos"].values())]
        declared = (self._declared, self._known, *([self._angles] if self._angles else []))
        mark = fingerprint([inside(self._root, path) for path in paths], location, *declared)
        return EpisodeRef(f"episode_{number:06d}", mark, location)

    def _check_rows(
        self, table: pa.Table, times: Float[np.ndarray, " N"], location: dict[str, Any], path: Path
    ) -> dict[str, str]:
        """Raises :class:`EpisodeError` if the rows are not this episode's frames, in order and evenly spaced.

        Returns:
            A note if the metadata state another range of rows; only this check reads that range.
        """
        count = len(times)
        number = location["episode"]
        if count != location["length"]:
            problem = f"{count} rows of episode {number}, metadata say {location['length']}"
            raise EpisodeError.at(path, problem, kind="length")
        expected = {"episode_index": np.full(count, number), "frame_index": np.arange(count)}
        notes: dict[str, str] = {}
        if "rows" in location:
            first = int(integers(table, "index", path)[0])
            expected["index"] = np.arange(first, first + count)
            if location["rows"] != [first, first + count]:
                says = " … ".join(map(str, location["rows"]))
                notes["range"] = f"rows {first} … {first + count}, where the metadata say {says}"
        for name, values in expected.items():
            column = integers(table, name, path)
            if (wrong := np.flatnonzero(column != values)).size:
                row = wrong[0]
                raise EpisodeError.at(path, f"{name} of row {row} is {column[row]}, should be {values[row]}")
        away = np.abs(np.diff(times) - 1 / self._info.fps)
        if (uneven := np.flatnonzero(~(away <= _tolerance(times)))).size:
            row = uneven[0]
            step = f"{times[row + 1] - times[row]:.4f} s after the one before, at {self._info.fps:g} fps"
            raise EpisodeError.at(path, f"timestamp of row {row + 1} comes {step}", kind="time")
        return notes


def _outcome(table: pa.Table, path: Path, notes: dict[str, str]) -> dict[str, Any]:
    """Returns what the columns ``next.…`` say of each frame: ``success`` and ``reward``, if they are there.

    Row t says what its action led to, so it counts for frame t + 1. The last row speaks of a frame that was not
    recorded; if that is a success, so is the last frame. Without ``next.success``, rewards that are all 0 or 1 say it.

    Args:
        notes: gets an entry if the episode goes on after ``next.done``.
    """
    columns = {}
    for name in (name for name in OUTCOME if name in table.column_names):
        values = matrix(table, name, path)
        if values.shape[1] != 1 or not np.isfinite(values).all():
            raise EpisodeError.at(path, f"column {name!r} is not one finite number a row")
        columns[name] = values[:, 0]
    made: dict[str, Any] = {}
    reward = columns.get("next.reward")
    success = columns.get("next.success")
    if reward is not None:
        made["reward"] = [0.0, *reward[:-1].tolist()]
        if success is None and np.isin(reward, (0, 1)).all():
            success = reward
    if success is not None:
        after = np.append(False, success[:-1] > 0)
        after[-1] |= success[-1] > 0
        made["success"] = after.tolist()
    done = np.flatnonzero(columns.get("next.done", np.zeros(1)) > 0)
    if done.size and done[0] < len(table) - 1:
        notes["done"] = f"next.done at row {done[0]}, after which {len(table) - 1 - done[0]} rows follow"
    return made


def _generated(path: Path) -> frozenset[int]:
    """Returns the numbers of the episodes that a world model generated, as an export of rsjax lists them."""
    if not exists(path):
        return frozenset()
    try:
        numbers = read_json(path)["generated_episodes"]
        if not isinstance(numbers, list) or not all(type(number) is int for number in numbers):
            raise TypeError(f"generated_episodes is {numbers!r:.40}, not a list of numbers")
    except (KeyError, TypeError) as error:
        raise SourceError(f"{path}: field missing or wrong ({error}); fetch the file again") from error
    return frozenset(numbers)


def _tasks(meta: Path, shared: bool) -> dict[int, str]:
    try:
        if not shared:
            return {int(row["task_index"]): words_of(row["task"]) for _, row in json_lines(meta / "tasks.jsonl")}
        names = ("task_index", "task", "__index_level_0__")  # the last is pandas's name for an unnamed index
        rows = parquet_rows(meta / "tasks.parquet", names)
        return {int(row["task_index"]): words_of(row.get("task", row.get("__index_level_0__"))) for row in rows}
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{meta}: its table of tasks is damaged ({error}); fetch the file again") from error


def _tolerance(times: Float[np.ndarray, " N"]) -> float:
    """Returns the largest error of a time in seconds: LeRobot's tolerance plus the rounding of float32 times."""
    return TOLERANCE + float(np.spacing(np.float32(np.abs(times).max(initial=0))))


def _camera(key: str) -> str:
    return key.removeprefix("observation.images.").removeprefix("observation.")


def read_rows(root: Path, template: str, location: dict[str, Any], columns: Sequence[str]) -> tuple[Path, pa.Table]:
    """Reads the rows of an episode.

    LeRobot's converter to v3 writes wrong metadata: for the first episode of every file but the first it names the
    previous file, and if the very first episode alone exceeds a file's size it names a file that does not exist. So if
    the file that the metadata name is missing or has no row of the episode, the other files are searched, the next one
    first.

    Args:
        template: template of the tables' paths.
        location: the episode's location.
        columns: the columns to read; those that the table lacks are left out.

    Returns:
        The file that has the rows, and the rows.

    Raises:
        EpisodeError: the named file cannot be read, or no file has a row of the episode.
    """
    named = inside(root, location["data"])
    number = location["episode"]
    failure = EpisodeError.at(named, f"has no row of episode {number}, nor has any other file", kind="length")
    shared = "rows" in location
    for path in (named, *(_others(root, template, named, number) if shared else ())):
        try:
            table = parquet_columns(path, columns, _only(location))
        except EpisodeError as error:
            if not (shared and isinstance(error.__cause__, FileNotFoundError)):
                raise
            failure = error
        else:
            if table.num_rows:
                return path, table
    raise failure


def _others(root: Path, template: str, named: Path, number: int) -> Iterator[Path]:
    """Yields the other files that have rows of an episode; files that cannot be read are skipped."""
    pattern = inside(root, re.sub(r"\{[^{}]*\}", "*", template)).relative_to(root)
    files = sorted(root.glob(str(pattern)))
    after = bisect.bisect_right(files, named)
    for path in (*files[after:], *reversed(files[:after])):
        try:
            status = path.stat()
            if number in _episodes_in(path, status.st_size, status.st_mtime_ns):
                yield path
        except (EpisodeError, OSError):
            continue


@lru_cache(maxsize=4096)
def _episodes_in(path: Path, size: int, modified: int) -> frozenset[int]:
    """Returns the episodes of a file; ``size`` and ``modified`` make the cache read a changed file again."""
    table = parquet_columns(path, ["episode_index"], _ALL)
    return frozenset(np.unique(integers(table, "episode_index", path)).tolist())


def _only(location: dict[str, Any]) -> list[tuple[str, str, int]] | None:
    """Returns the filter that selects one episode from a shared table; None if the table holds only this episode."""
    if "rows" in location:
        return [("episode_index", "==", location["episode"])]
    return None


@dataclass(frozen=True, eq=False)
class TablePictures:
    """Encoded pictures in an episode's table, as :class:`rsjax.tools.ingest.episode.Frames`.

    Attributes:
        path: the table.
        column: a column of ``{bytes, path}``.
        location: the episode's location.
    """

    path: Path
    column: str
    location: dict[str, Any]

    def __len__(self) -> int:
        return self.location["length"]

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        """Returns these pictures; :class:`EpisodeError` names one that is missing or damaged."""
        table = parquet_columns(self.path, [self.column], _only(self.location))
        if self.column not in table.column_names:
            raise EpisodeError.at(self.path, f"has no column {self.column!r}")
        if table.num_rows != len(self):
            raise EpisodeError.at(self.path, f"{table.num_rows} rows of {self.column}, not {len(self)}")
        cells = table[self.column].take(list(indices)).to_pylist()
        payloads: list[tuple[str, bytes]] = []
        for index, cell in zip(indices, cells, strict=True):
            where = f"{self.path}: {self.column} of row {index}"
            if isinstance(cell, dict):
                payload = cell.get("bytes")
            else:
                payload = cell
            if not isinstance(payload, bytes):
                raise EpisodeError.at(where, "has no encoded picture", kind="undecodable")
            payloads.append((where, payload))
        return decode_pictures(payloads)
