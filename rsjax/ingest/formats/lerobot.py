"""LeRobotDataset v2.0, v2.1 and v3.0 without the ``lerobot`` package: pyarrow for the tables, PyAV for the videos.

A row's action is given at that row's frame, so it leads into the next one. v2 has a table and a video per episode and
camera; in v3 many episodes share a file, and an episode's pictures are found by time.
"""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float, UInt8

from rsjax.ingest.actions import Kind, Layout, check_layout, led_into
from rsjax.ingest.episode import (
    Episode,
    EpisodeError,
    EpisodeRef,
    Frames,
    Segment,
    SourceError,
    checked,
    fingerprint,
    safe_id,
)
from rsjax.ingest.formats.files import (
    broken,
    filled,
    inside,
    integers,
    json_lines,
    location_of,
    matrix,
    media,
    parquet_columns,
    parquet_rows,
    seconds,
)
from rsjax.ingest.formats.lerobot_info import Info
from rsjax.ingest.pictures import decode_picture
from rsjax.ingest.video import at_times

TOLERANCE = 1e-4  # seconds, LeRobot's own
_CURE = "mend the data set or leave the episode out"
_PLACES = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")


class LeRobot:
    """A LeRobotDataset, as :class:`rsjax.ingest.episode.EpisodeSource`; made by :func:`open_source`."""

    name = "lerobot"

    def __init__(self, root: Path, info: Info, tasks: dict[int, str], layout: Layout, action: str, state: str) -> None:
        self._root, self._info, self._tasks, self._layout = root, info, tasks, layout
        self._action, self._state = action, state

    def episodes(self) -> Iterator[EpisodeRef]:
        """Every episode of ``meta/episodes``; a bad or repeated entry becomes a reference that cannot be read."""
        seen: set[int] = set()
        listed = 0
        for where, row in self._rows():
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
                yield broken(identity, f"{where}: field missing or wrong ({error}); {_CURE}")
        if listed < (self._info.episodes or 0):
            told = f"total_episodes is {self._info.episodes}, meta lists only {listed}"
            yield broken("meta-info", f"{self._root}/meta/info.json: {told}; {_CURE}")

    def read(self, ref: EpisodeRef) -> Episode:
        """One episode; its pictures are not decoded, but their times are checked."""
        location = location_of(ref)
        path = inside(self._root, location["data"])
        table = self._table(path, location)
        number, count = location["episode"], table.num_rows
        if count != location["length"]:
            told = f"{path}: {count} rows of episode {number}, metadata say {location['length']}; {_CURE}"
            raise EpisodeError(told, "length")
        times = seconds(table, "timestamp", path)
        self._check_rows(table, times, location, path)
        actions = matrix(table, self._action, path)
        check_layout(self._layout, actions.shape[1], path)
        states = matrix(table, self._state, path) if self._state in table.column_names else None
        tasks = self._task_of_rows(table, path)
        task = tasks[0] if tasks and len(set(tasks)) == 1 else "; ".join(location["tasks"])
        episode = Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task=task,
            fps=self._info.fps,
            timestamps=times - times[0],
            actions=led_into(actions),
            states=states,
            cameras=self._cameras(location, times, path),
            segments=_runs(tasks),
            meta={"actions": self._layout.to_json(), "action_names": self._info.features[self._action].get("names")},
        )
        return checked(episode, path)

    def _rows(self) -> Iterator[tuple[str, Any]]:
        """(where it stands, an episode's metadata)."""
        meta = self._root / "meta"
        if not self._info.shared:
            path = meta / "episodes.jsonl"
            yield from ((f"{path}: line {number}", row) for number, row in json_lines(path))
            return
        columns = ["episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index"]
        columns += [f"data/{name}" for name in _PLACES[:2]]
        columns += [f"videos/{key}/{name}" for key in self._info.of_type("video") for name in _PLACES]
        files = sorted((meta / "episodes").glob("*/*.parquet"))
        if not files:
            raise SourceError(f"{meta / 'episodes'}: holds no Parquet files; fetch the data set again")
        for path in files:
            try:
                yield from ((f"{path}: row {number}", row) for number, row in enumerate(parquet_rows(path, columns)))
            except SourceError as error:  # the other files' episodes can be read all the same
                yield str(path.relative_to(meta)), error

    def _ref(self, number: int, row: dict[str, Any]) -> EpisodeRef:
        length, tasks = int(row["length"]), [str(task) for task in row.get("tasks") or ()]
        if number < 0 or length < 0:
            raise ValueError(f"episode_index {number}, length {length}")
        info, videos = self._info, {}
        chunk = {"episode_chunk": number // info.chunks_size, "episode_index": number}
        at = {name: int(row[f"data/{name}"]) for name in _PLACES[:2]} if info.shared else chunk
        location: dict[str, Any] = {"episode": number, "length": length, "tasks": tasks}
        location["data"] = filled(info.data_path, **at)
        if info.shared:
            location["rows"] = [int(row["dataset_from_index"]), int(row["dataset_to_index"])]
        for key in info.of_type("video"):
            if info.shared:
                at = {name: int(row[f"videos/{key}/{name}"]) for name in _PLACES[:2]}
            begins = float(row[f"videos/{key}/from_timestamp"]) if info.shared else 0.0
            videos[key] = {"path": filled(info.video_path, video_key=key, **at), "from": begins}
        location["videos"] = videos
        files = [inside(self._root, name) for name in (location["data"], *(video["path"] for video in videos.values()))]
        return EpisodeRef(f"episode_{number:06d}", fingerprint(files, location, self._layout), location)

    def _table(self, path: Path, location: dict[str, Any]) -> pa.Table:
        names = ("timestamp", "frame_index", "episode_index", "index", "task_index", self._action, self._state)
        return parquet_columns(path, names, filters=_only(location) if self._info.shared else None)

    def _check_rows(
        self, table: pa.Table, times: Float[np.ndarray, " N"], location: dict[str, Any], path: Path
    ) -> None:
        """Raises :class:`EpisodeError` where the rows are not this episode's frames, in order and evenly spaced."""
        count, number = len(times), location["episode"]
        if count == 0:
            raise EpisodeError(f"{path}: episode {number} has no frames; leave it out", "length")
        first, end = location.get("rows", (None, None))
        expected = {"episode_index": np.full(count, number), "frame_index": np.arange(count)}
        if first is not None:
            if end - first != count:
                raise EpisodeError(f"{path}: episode {number} is {first} … {end} of the rows, but has {count}; {_CURE}")
            expected["index"] = np.arange(first, end)
        for name, values in expected.items():
            found = integers(table, name, path)
            if (wrong := np.flatnonzero(found != values)).size:
                row = wrong[0]
                raise EpisodeError(f"{path}: {name} of row {row} is {found[row]}, should be {values[row]}; {_CURE}")
        away = np.abs(np.diff(times) - 1 / self._info.fps)
        if (uneven := np.flatnonzero(~(away <= _tolerance(times)))).size:
            row = uneven[0]
            step = f"{times[row + 1] - times[row]:.4f} s after the one before, at {self._info.fps:g} fps"
            raise EpisodeError(f"{path}: timestamp of row {row + 1} comes {step}; {_CURE}", "time")

    def _task_of_rows(self, table: pa.Table, path: Path) -> list[str]:
        if "task_index" not in table.column_names or not self._tasks:
            return []
        indices = integers(table, "task_index", path).tolist()
        if unknown := set(indices) - set(self._tasks):
            raise EpisodeError(f"{path}: task_index {min(unknown)} is not among the data set's tasks; {_CURE}")
        return [self._tasks[index] for index in indices]

    def _cameras(self, location: dict[str, Any], times: Float[np.ndarray, " N"], path: Path) -> dict[str, Frames]:
        cameras: dict[str, Frames] = {}
        for key, video in location["videos"].items():
            file = media(inside(self._root, video["path"]))
            cameras[_camera(key)] = at_times(file, times + video["from"], _tolerance(times))
        for key in self._info.of_type("image"):
            cameras[_camera(key)] = TablePictures(path, key, location, len(times))
        return cameras


class TablePictures:
    """Pictures that lie encoded in an episode's table, as :class:`rsjax.ingest.episode.Frames`.

    Args:
        path: the table.
        column: of ``{bytes, path}``.
        location: which rows are the episode's.
        count: how many there are.
    """

    def __init__(self, path: Path, column: str, location: dict[str, Any], count: int) -> None:
        self._path, self._column, self._location, self._count = path, column, location, count

    def __len__(self) -> int:
        return self._count

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        """These pictures; :class:`EpisodeError` names one that is missing or damaged."""
        filters = _only(self._location) if "rows" in self._location else None
        table = parquet_columns(self._path, [self._column], filters)
        if self._column not in table.column_names:
            raise EpisodeError(f"{self._path}: has no column {self._column!r}; {_CURE}")
        if table.num_rows != self._count:
            raise EpisodeError(f"{self._path}: {table.num_rows} rows of {self._column}, not {self._count}; {_CURE}")
        pictures = []
        for index, cell in zip(indices, table[self._column].take(list(indices)).to_pylist(), strict=True):
            where = f"{self._path}: {self._column} of row {index}"
            payload = cell.get("bytes") if isinstance(cell, dict) else cell
            if not isinstance(payload, bytes):
                raise EpisodeError(f"{where}: holds no encoded picture; {_CURE}", "undecodable")
            pictures.append(decode_picture(payload, where))
        if len({picture.shape for picture in pictures}) > 1:
            raise EpisodeError(f"{self._path}: {self._column} has pictures of several sizes; {_CURE}")
        return np.stack(pictures)


def open_source(
    path: Path,
    *,
    action: str = "action",
    state: str = "observation.state",
    kind: Kind = "absolute",
    held: Sequence[int] = (),
    quaternions: Sequence[int] = (),
) -> LeRobot:
    """The data set at ``path``, the folder that holds ``meta``.

    Args:
        action: the column of actions.
        state: the column of states; where it is not there, episodes have none.
        kind: what the actions are, which the format does not say; see :class:`rsjax.ingest.actions.Layout`.
        held: likewise.
        quaternions: likewise.

    Raises:
        SourceError: ``meta`` cannot be read, or there is no such column of actions.
    """
    info = Info.read(path / "meta" / "info.json")
    if action not in info.features:
        raise SourceError(f"{path}: has no column {action!r}; choose among {', '.join(info.features)}")
    tasks = _tasks(path / "meta", info.shared)
    return LeRobot(path, info, tasks, Layout(kind, tuple(quaternions), tuple(held)), action, state)


def _tasks(meta: Path, shared: bool) -> dict[int, str]:
    try:
        if not shared:
            return {int(row["task_index"]): str(row["task"]) for _, row in json_lines(meta / "tasks.jsonl")}
        names = ("task_index", "task", "__index_level_0__")  # where pandas leaves an index of its own
        rows = parquet_rows(meta / "tasks.parquet", names)
        return {int(row["task_index"]): str(row.get("task", row.get("__index_level_0__", ""))) for row in rows}
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{meta}: its table of tasks is damaged ({error}); fetch the file again") from error


def _tolerance(times: Float[np.ndarray, " N"]) -> float:
    """Seconds that a time may be off: LeRobot's, and what float32, in which times are stored, rounds away."""
    return TOLERANCE + float(np.spacing(np.float32(np.abs(times).max(initial=0))))


def _only(location: dict[str, Any]) -> list[tuple[str, str, int]]:
    return [("episode_index", "==", location["episode"])]


def _camera(key: str) -> str:
    return key.removeprefix("observation.images.").removeprefix("observation.")


def _runs(tasks: list[str]) -> tuple[Segment, ...]:
    """Parts with one task each; none where the whole episode has one."""
    starts = [0, *(row for row in range(1, len(tasks)) if tasks[row] != tasks[row - 1]), len(tasks)]
    if len(starts) <= 2:
        return ()
    return tuple(Segment(start, end, tasks[start]) for start, end in itertools.pairwise(starts))
