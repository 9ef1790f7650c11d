"""Reads AgiBot-World Alpha and Beta, unpacked: two arms, 30 fps, and known damage.

``observations/{task}/{episode}/{videos,depth}``, ``proprio_stats/{task}/{episode}/proprio_stats.h5``,
``task_info/task_{task}.json``. An action has 16 dimensions: both hands' positions (6, m), their orientations (8,
quaternions x y z w) and both grippers (2, 0 open … 1 closed).

An arm's command at frame t leads into frame t+1, unless an episode's commands are a copy of its states: then the pose
of frame t led into frame t, and rows stay where they are. Gripper commands always lead into the next frame.
"""

import fnmatch
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from rsjax.clip import words_of
from rsjax.files import safe_id
from rsjax.tools.ingest.actions import Layout, align_actions
from rsjax.tools.ingest.episode import Episode, EpisodeRef, Segment, SourceError, checked, fingerprint, reason
from rsjax.tools.ingest.formats.agibot_proprio import Proprio
from rsjax.tools.ingest.formats.files import broken, exists, inside, location_of, media, read_json, subfolders
from rsjax.tools.ingest.formats.hdf5 import open_file
from rsjax.tools.ingest.pictures import PictureFiles
from rsjax.tools.ingest.video import VideoFrames

FPS = 30.0
CAMERAS = ("head", "hand_left", "hand_right")
LAYOUT = Layout("absolute", quaternions=(6, 10), held=(14, 15))
_FOLDERS = ("observations", "proprio_stats")


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
        self._root, self._cameras, self._only = root, tuple(cameras), tuple(tasks)

    def episodes(self) -> Iterator[EpisodeRef]:
        """Lists every episode on disk or in ``task_info``, task by task; an episode not on disk cannot be read."""
        for task in self._tasks():
            path = self._root / "task_info" / f"task_{task}.json"
            entries: dict[str, dict[str, Any]] = {}
            try:
                for place, entry in enumerate(_entries(path) if exists(path) else ()):
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
                    on_disk |= {entry.name for entry in subfolders(folder)} if exists(folder) else set()
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
            times, states, actions = proprio.seconds(), proprio.states(), _actions(proprio)
        folder = inside(self._root, f"observations/{place}")
        segments, bad = _segments(location["segments"], len(times))
        depth, why_not = _depth(folder / "depth", len(times))
        unnamed = "" if location["told"] else "names no such episode, so it has no task"
        notes = {"task_info": unnamed, "bad_segments": bad, "depth_left_out": why_not, **proprio.notes}
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
            segments=segments,
            meta={
                "task_id": location["task"],
                "episode_id": location["episode"],
                "scene": location["scene"],
                "actions": LAYOUT.to_json(),
                "notes": {name: note for name, note in notes.items() if note},
            },
        )
        return checked(episode, path)

    def _tasks(self) -> list[str]:
        info, observations = self._root / "task_info", self._root / "observations"
        if not exists(info) and not exists(observations):
            raise SourceError(f"{self._root}: has neither task_info nor observations; unpack the data set")
        tasks = {path.stem.removeprefix("task_") for path in info.glob("task_*.json")}
        for folder in (self._root / name for name in _FOLDERS):
            tasks |= {path.name for path in subfolders(folder)} if exists(folder) else set()
        if absent := [task for task in self._only if task not in tasks]:
            raise SourceError(f"{self._root}: has no task {absent[0]}; it has {', '.join(sorted(tasks))}")
        return sorted(self._only or tasks, key=lambda name: (len(name), name))

    def _ref(self, task: str, identity: str, entry: dict[str, Any]) -> EpisodeRef:
        labels = entry.get("label_info")
        segments = labels.get("action_config") if isinstance(labels, dict) else None
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
        return EpisodeRef(safe_id(f"{task}-{identity}"), fingerprint(files, location), location)


def _entries(path: Path) -> list[dict[str, Any]]:
    entries = read_json(path)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise SourceError(f"{path}: should be a list of episodes; fetch the file again")
    return entries


def _actions(proprio: Proprio) -> Float32[np.ndarray, "N 16"]:
    hands = np.concatenate([proprio.command("end/position"), proprio.quaternions("action/end/orientation")], 1)
    with np.errstate(over="ignore"):
        hands = hands.astype(np.float32)
    return np.concatenate([align_actions(hands, after=proprio.copied()), align_actions(proprio.grippers())], 1)


def _segments(entries: list[Any], count: int) -> tuple[tuple[Segment, ...], list[Any]]:
    """Returns the data set's own segments of the episode, and the entries that are not valid segments."""
    good, bad = [], []
    for entry in entries:
        try:
            start, end = int(entry["start_frame"]), min(int(entry["end_frame"]), count)
            if not 0 <= start < end:
                raise ValueError(f"{start} … {end}")
            good.append(Segment(start, end, words_of(entry.get("action_text")), words_of(entry.get("skill"))))
        except (KeyError, TypeError, ValueError):
            bad.append(entry)
    return tuple(sorted(good, key=lambda segment: segment.start)), bad


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
