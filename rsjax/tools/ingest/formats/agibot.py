"""Reads AgiBot-World Alpha and Beta, unpacked: two arms, 30 fps, and known damage.

``observations/{task}/{episode}/{videos,depth}``, ``proprio_stats/{task}/{episode}/proprio_stats.h5``,
``task_info/task_{task}.json``. An action has 16 dimensions: both hands' positions (6, m), their orientations (8,
quaternions x y z w) and both grippers (2, 0 open … 1 closed).

An arm's command at frame t leads into frame t+1, unless an episode's commands are a copy of its states: then the pose
of frame t led into frame t, and rows stay where they are. Gripper commands always lead into the next frame.

Axes: N frames, M ≤ N commands, D dimensions.
"""

import fnmatch
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float32, Float64, Int64

from rsjax.clip import words_of
from rsjax.files import safe_id
from rsjax.tools.ingest.actions import ActionLayout, align_actions, continuous_signs
from rsjax.tools.ingest.episode import (
    LEAVE_OUT,
    Episode,
    EpisodeError,
    EpisodeRef,
    Segment,
    SourceError,
    checked,
    fingerprint,
    reason,
)
from rsjax.tools.ingest.formats.files import (
    MAX_CELLS,
    broken,
    exists,
    inside,
    location_of,
    media,
    read_json,
    subfolders,
)
from rsjax.tools.ingest.formats.hdf5 import member, open_file
from rsjax.tools.ingest.pictures import PictureFiles
from rsjax.tools.ingest.video import VideoFrames

FPS = 30.0
CAMERAS = ("head", "hand_left", "hand_right")
LAYOUT = ActionLayout("absolute", quaternions=(6, 10), held=(14, 15))
_FOLDERS = ("observations", "proprio_stats")
_WIDTHS = {
    "end/position": 6,
    "end/orientation": 8,
    "effector/position": 2,
    "joint/position": 14,
    "head/position": 2,
    "waist/position": 2,
}


def open_source(path: Path, *, cameras: Sequence[str] = CAMERAS, tasks: Sequence[int | str] = ()) -> "AgiBot":
    """Opens the data set at ``path``.

    Args:
        cameras: names of videos without ``_color.mp4``; an episode needs all of them.
        tasks: numbers of the tasks to read; none: all.
    """
    return AgiBot(path, cameras, [str(task) for task in tasks])


class AgiBot:
    """AgiBot-World, as :class:`rsjax.tools.ingest.episode.EpisodeSource`; :func:`open_source` builds it."""

    name = "agibot"

    def __init__(self, root: Path, cameras: Sequence[str], tasks: Sequence[str]) -> None:
        self._root = root
        self._cameras = tuple(cameras)
        self._only = tuple(tasks)

    def episodes(self) -> Iterator[EpisodeRef]:
        """Lists every episode on disk or in ``task_info``, task by task; an episode not on disk cannot be read."""
        info = self._root / "task_info"
        observations = self._root / "observations"
        if not exists(info) and not exists(observations):
            raise SourceError(f"{self._root}: has neither task_info nor observations; unpack the data set")
        tasks = {path.stem.removeprefix("task_") for path in info.glob("task_*.json")}
        for folder in (self._root / name for name in _FOLDERS):
            if exists(folder):
                tasks |= {path.name for path in subfolders(folder)}
        if absent := [task for task in self._only if task not in tasks]:
            raise SourceError(f"{self._root}: has no task {absent[0]}; it has {', '.join(sorted(tasks))}")
        for task in sorted(self._only or tasks, key=lambda name: (len(name), name)):
            path = self._root / "task_info" / f"task_{task}.json"
            entries: dict[str, dict[str, Any]] = {}
            try:
                listed: Any = []
                if exists(path):
                    listed = read_json(path)
                if not isinstance(listed, list) or not all(isinstance(entry, dict) for entry in listed):
                    raise SourceError(f"{path}: should be a list of episodes; fetch the file again")
                for place, entry in enumerate(listed):
                    identity = str(entry.get("episode_id", ""))
                    if not identity.isdecimal() or identity in entries:
                        message = f"{path}: episode_id of entry {place} is missing or there already; mend the file"
                        yield broken(safe_id(f"task_{task}-entry_{place}"), message)
                    else:
                        entries[identity] = entry
            except SourceError as error:
                yield broken(safe_id(f"task_{task}"), str(error))
            on_disk: set[str] = set()
            for name in _FOLDERS:
                folder = self._root / name / task
                try:
                    if exists(folder):
                        on_disk |= {entry.name for entry in subfolders(folder)}
                except SourceError as error:
                    yield broken(safe_id(f"task_{task}-{name}"), str(error))
            for identity in sorted(on_disk | entries.keys(), key=lambda name: (len(name), name)):
                yield self._ref(task, identity, entries.get(identity, {}))

    def read(self, ref: EpisodeRef) -> Episode:
        """Reads one episode."""
        location = location_of(ref)
        place = f"{location['task']}/{location['episode']}"
        path = inside(self._root, f"proprio_stats/{place}/proprio_stats.h5")
        with open_file(path) as file:
            proprio = Proprio(file, path)
            times = proprio.seconds()
            states = proprio.states()
            hands = np.concatenate([proprio.command("end/position"), proprio.quaternions("action/end/orientation")], 1)
            with np.errstate(over="ignore"):
                hands = hands.astype(np.float32)
            hands = align_actions(hands, after=proprio.copied())
            actions = np.concatenate([hands, align_actions(proprio.grippers())], 1)
            actions[:1] = 0  # the grippers' first commands are unknown
        folder = inside(self._root, f"observations/{place}")
        segments = []
        bad_segments = []
        for entry in location["segments"]:
            try:
                start = int(entry["start_frame"])
                end = min(int(entry["end_frame"]), len(times))
                if not 0 <= start < end:
                    raise ValueError(f"{start} … {end}")
                segments.append(Segment(start, end, words_of(entry.get("action_text")), words_of(entry.get("skill"))))
            except (KeyError, TypeError, ValueError):
                bad_segments.append(entry)
        depth, why_not = _depth(folder / "depth", len(times))
        unnamed = "names no such episode, so it has no task"
        if location["told"]:
            unnamed = ""
        notes = {"task_info": unnamed, "bad_segments": bad_segments, "depth_left_out": why_not, **proprio.notes}
        episode = Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task=location["name"],
            fps=FPS,
            timestamps=times,
            actions=actions,
            states=states,
            cameras={name: VideoFrames(media(folder / "videos" / f"{name}_color.mp4")) for name in self._cameras},
            depth={"head": depth} if depth and "head" in self._cameras else {},
            segments=tuple(sorted(segments, key=lambda segment: segment.start)),
            meta={
                "task_id": location["task"],
                "episode_id": location["episode"],
                "scene": location["scene"],
                "actions": LAYOUT.to_json(),
                "notes": {name: note for name, note in notes.items() if note},
            },
        )
        return checked(episode, path)

    def _ref(self, task: str, identity: str, entry: dict[str, Any]) -> EpisodeRef:
        labels = entry.get("label_info")
        segments = None
        if isinstance(labels, dict):
            segments = labels.get("action_config")
        location = {
            "task": task,
            "episode": identity,
            "told": bool(entry),  # the fingerprint depends on this name
            "name": words_of(entry.get("task_name")),
            "scene": words_of(entry.get("init_scene_text")),
            "segments": segments if isinstance(segments, list) else [],
        }
        videos = self._root / "observations" / task / identity / "videos"
        files = [self._root / "proprio_stats" / task / identity / "proprio_stats.h5"]
        files += [videos / f"{name}_color.mp4" for name in self._cameras]
        made_of = fingerprint(files, location)
        maps = self._root / "observations" / task / identity / "depth"
        with suppress(OSError):  # without maps; those that may not be read are named when the episode is read
            made_of = fingerprint([], made_of, sorted((path.name, path.stat().st_size) for path in maps.iterdir()))
        return EpisodeRef(safe_id(f"{task}-{identity}"), made_of, location)


class Proprio:
    """The arrays of an open file, each flattened to (rows, D).

    Attributes:
        notes: what had to be repaired, JSON-ready: fields that are empty, commands that do not cover all frames,
            quaternions that changed sign.
    """

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._file = file
        self._path = path
        self.notes: dict[str, Any] = {"empty": [], "scattered": {}, "flipped": {}}
        self._stamps = self._rows("timestamp", 1)[:, 0]
        self._count = len(self._stamps)
        if not self._count:
            raise self._error("timestamp is missing or empty")

    def _error(self, problem: str) -> EpisodeError:
        return EpisodeError.at(self._path, problem, LEAVE_OUT)

    def seconds(self) -> Float64[np.ndarray, " N"]:
        """Returns the seconds since the first frame; the file has nanoseconds."""
        whole = self._stamps.dtype.kind in "iu"
        stamps = self._stamps
        if whole:
            stamps = stamps.astype(np.int64)  # differences of unsigned ones wrap around
        return (stamps - stamps[0]).astype(np.float64) / 1e9

    def states(self) -> Float32[np.ndarray, "N 34"]:
        """Positions (6, m), orientations (8), grippers (2, mm), joints (14, rad), head (2, rad), waist (2, rad, m)."""
        parts = {name: self._state(name) for name in _WIDTHS}
        parts["end/orientation"] = self.quaternions("state/end/orientation")
        with np.errstate(over="ignore"):  # values beyond float32 become infinite, which is refused later
            return np.concatenate(list(parts.values()), 1).astype(np.float32)

    def quaternions(self, name: str) -> Float64[np.ndarray, "N 8"]:
        """Returns both hands' quaternions at every frame, each with continuous signs. Raises as :meth:`command`."""
        kind, _, field = name.partition("/")
        if kind == "state":
            pair = self._state(field)
        else:
            pair = self.command(field)
        mended = np.concatenate([continuous_signs(pair[:, :4]), continuous_signs(pair[:, 4:])], 1)
        if rows := int((mended != pair).any(1).sum()):
            self.notes["flipped"][name] = rows
        return mended

    def command(self, name: str) -> Float64[np.ndarray, "N D"]:
        """Returns ``action/name`` at every frame; the state where no command was sent, zeros if the field is empty.

        Raises:
            EpisodeError: there are more commands than frames, or it is unknown at which frames they were sent.
        """
        commands = self._commands(name)
        if not len(commands):
            return np.zeros((self._count, _WIDTHS[name]))
        extended = self._state(name)
        extended[self._index(name, len(commands))] = commands
        return extended

    def grippers(self) -> Float64[np.ndarray, "N 2"]:
        """Returns ``action/effector/position`` at every frame: the last command sent, and 0 (open) before the first.

        The state cannot replace it, because it is in millimetres. Raises as :meth:`command`.
        """
        commands = self._commands("effector/position")
        extended = np.zeros((self._count, 2))
        if len(commands):
            index = self._index("effector/position", len(commands))
            last = np.searchsorted(index, np.arange(self._count), side="right") - 1
            extended[last >= 0] = commands[last[last >= 0]]
        return extended

    def copied(self) -> bool:
        """Returns whether the hands' commands equal the states at the same frames, so that they predict nothing."""
        for name in ("end/position", "end/orientation"):
            commands = self._commands(name)
            if not len(commands):
                return False
            index = self._index(name, len(commands))
            if not np.allclose(commands, self._state(name)[index], rtol=0, atol=1e-6):
                return False
        return True

    def _state(self, name: str) -> Float64[np.ndarray, "N D"]:
        rows = self._noted_rows(f"state/{name}", _WIDTHS[name])
        if not len(rows):
            return np.zeros((self._count, _WIDTHS[name]))
        if len(rows) != self._count:
            raise self._error(f"state/{name} has {len(rows)} rows, timestamp {self._count}")
        return rows

    def _commands(self, name: str) -> Float64[np.ndarray, "M D"]:
        rows = self._noted_rows(f"action/{name}", _WIDTHS[name])
        if len(rows) > self._count:
            raise self._error(f"action/{name} has {len(rows)} rows, more than {self._count}")
        return rows

    def _index(self, name: str, count: int) -> Int64[np.ndarray, " M"]:
        """Returns the frames at which the commands of a field were sent."""
        if count == self._count:
            return np.arange(count)
        for chosen in (f"action/{name.partition('/')[0]}/index", "action/joint/index"):
            if len(index := self._rows(chosen, 1)[:, 0]):
                break
        if len(index) != count:
            raise self._error(f"action/{name} has {count} rows, {chosen} {len(index)}")
        places = index.astype(np.int64)
        if (places != index).any() or places[0] < 0 or places[-1] >= self._count or (np.diff(places) <= 0).any():
            raise self._error(f"{chosen} is not increasing within 0 … {self._count - 1}")
        self.notes["scattered"][name] = count
        return places

    def _noted_rows(self, name: str, width: int) -> np.ndarray:
        """Returns :meth:`_rows`, and notes a field that is empty."""
        rows = self._rows(name, width)
        if not len(rows) and name not in self.notes["empty"]:
            self.notes["empty"].append(name)
        return rows

    def _rows(self, name: str, width: int) -> np.ndarray:
        """Reads a data set as (rows, width), with no rows if it is missing or empty; float64, but times as stored."""
        data = member(self._file, name, self._path)
        if not isinstance(data, h5py.Dataset) or not data.size:
            return np.zeros((0, width))
        if data.size > MAX_CELLS or data.dtype.kind not in "fiu" or not data.ndim:
            raise self._error(f"{name} is {data.dtype} {data.shape}, no table of numbers")
        if data.size != len(data) * width:
            hint = ""
            if name.endswith("effector/position") and data.size == len(data) * 12:
                hint = ", a dexterous hand"
            raise self._error(f"{name} has shape {data.shape}, not {width} numbers a row{hint}")
        rows = data[()].reshape(-1, width)
        if name == "timestamp":
            return rows
        return rows.astype(np.float64)


def _depth(folder: Path, count: int) -> tuple[PictureFiles | None, str]:
    """Returns the head camera's depth maps in mm, or why they are left out."""
    try:
        names = [path.name for path in folder.iterdir()]
    except FileNotFoundError:
        return None, ""
    except OSError as error:
        return None, f"{folder.name} {reason(error)}"
    chosen = sorted(fnmatch.filter(names, "head_depth*.png"), key=lambda name: (len(name), name))
    paths = [media(folder / name) for name in chosen]
    if len(paths) != count:
        return None, f"{len(paths)} depth maps for {count} frames" if paths else ""
    return PictureFiles(paths, depth=True), ""
