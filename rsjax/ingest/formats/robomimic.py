"""robomimic HDF5 files: ``data/demo_i`` with ``actions`` and ``obs/<key>``, ``mask/<filter>`` that lists demos.

``obs[t]`` was recorded before ``actions[t]``, which led to ``obs[t + 1]``. The files that robomimic offers for download
hold no pictures: users render them with its ``dataset_states_to_obs.py``. LIBERO's files have the same layout with
other conventions (:mod:`rsjax.ingest.formats.libero`), so both are read here, each by its :class:`Convention`.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float32

from rsjax.errors import did_you_mean
from rsjax.ingest.actions import Layout, led_into, unflipped
from rsjax.ingest.episode import (
    MAX_FPS,
    Episode,
    EpisodeError,
    EpisodeRef,
    SourceError,
    checked,
    fingerprint,
    safe_id,
)
from rsjax.ingest.formats.hdf5 import H5Depths, H5Frames, attribute, open_file, own, rows

_RENDER = "render them with robomimic's dataset_states_to_obs.py --camera_names …"


@dataclass(frozen=True)
class Convention:
    """What differs between the data sets of this layout.

    Attributes:
        name: of the format.
        endings: of the pictures' keys below ``obs``, in place of which the camera's name ends.
        states: keys below ``obs`` that make up the state, as far as a file has them.
        quaternions: those of them that are one; their sign is made continuous.
        after: whether ``obs[t]`` was recorded after ``actions[t]``.
        turned: whether pictures are upside down, by half a turn.
        fps: where the file does not say.
    """

    name: str
    endings: tuple[str, ...]
    states: tuple[str, ...]
    quaternions: tuple[str, ...] = ()
    after: bool = False
    turned: bool = False
    fps: float = 20.0


ROBOMIMIC = Convention(
    "robomimic",
    ("_image",),
    ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"),
    ("robot0_eef_quat",),
)


def open_source(path: Path, filter: str = "", depth: bool = False) -> "DemoSource":
    """A robomimic data set.

    Args:
        path: an HDF5 file, or a folder of such.
        filter: only demos that ``mask/<filter>`` lists, such as ``train``.
        depth: take ``obs/<camera>_depth`` as metres.

    Raises:
        SourceError: there are no files, none has pictures, or the filter is unknown.
    """
    return open_demos(path, ROBOMIMIC, filter, depth)


def open_demos(path: Path, convention: Convention, filter: str, depth: bool) -> "DemoSource":
    """A data set of this layout. Arguments and errors as in :func:`open_source`."""
    if path.is_file():
        source = DemoSource(path.parent, (path.name,), convention, filter, depth)
    else:
        found = sorted({file for ending in ("hdf5", "h5") for file in path.glob(f"**/*.{ending}") if file.is_file()})
        if not found:
            raise SourceError(f"{path}: no *.hdf5 files; give the {convention.name} file, or the folder with them")
        source = DemoSource(path, tuple(str(file.relative_to(path)) for file in found), convention, filter, depth)
    source.check_pictures()
    return source


@dataclass
class DemoSource:
    """See :class:`rsjax.ingest.episode.EpisodeSource`.

    Attributes:
        folder: what the files' names are relative to.
        files: in order.
        convention: how to read them.
        filter: of demos; "": all.
        depth: whether depth maps are read.
        name: the convention's.
    """

    folder: Path
    files: tuple[str, ...]
    convention: Convention
    filter: str = ""
    depth: bool = False
    name: str = field(init=False)

    def __post_init__(self) -> None:
        self.name = self.convention.name

    def episodes(self) -> Iterator[EpisodeRef]:
        """Each file's demos by their numbers. A file that cannot be read is one entry, which ``read`` refuses."""
        for file in self.files:
            path, stem = self.folder / file, file.rpartition(".")[0]
            try:
                demos = self._demos(path)
            except EpisodeError as error:
                where = {"file": file, "demo": "", "damage": str(error)}
                yield EpisodeRef(safe_id(stem.replace("/", "-")), fingerprint([path]), where)
                continue
            for demo in demos:
                marks = fingerprint([path], demo, asdict(self.convention), self.depth)
                where = {"file": file, "demo": demo, "damage": ""}
                yield EpisodeRef(safe_id(f"{stem.replace('/', '-')}-{demo}"), marks, where)

    def read(self, ref: EpisodeRef) -> Episode:
        """One demo."""
        file, demo = ref.location["file"], ref.location["demo"]
        if file not in self.files:
            raise EpisodeError(f"{self.folder}: holds no file {file!r} of its own; list it again")
        if ref.location["damage"]:
            raise EpisodeError(ref.location["damage"])
        path = self.folder / file
        with open_file(path) as opened:
            group = own(opened, f"data/{demo}", path)
            if not isinstance(group, h5py.Group) or not isinstance(own(group, "obs", path), h5py.Group):
                raise EpisodeError(f"{path}: has no data/{demo}/obs; leave the episode out")
            told = _told(opened["data"], path)
            return checked(self._episode(ref, path, group, told), f"{path}: data/{demo}")

    def _episode(self, ref: EpisodeRef, path: Path, group: Any, told: dict[str, Any]) -> Episode:
        how = self.convention
        commands = rows(group, "actions", path)
        said = attribute(group, "num_samples", path)
        if said is not None and int(said) != len(commands):
            raise EpisodeError(f"{path}: {group.name}/actions has {len(commands)} rows, num_samples says {int(said)}")
        actions = led_into(commands)
        if how.after:
            actions = np.concatenate([np.zeros_like(commands[:1]), commands[1:]])
        cameras = {camera: f"{group.name}/obs/{key}" for camera, key in picture_keys(group["obs"], how).items()}
        if not cameras:
            raise EpisodeError(f"{path}: {group.name}/obs has no pictures (*{how.endings[0]}); {_RENDER}")
        depths = {camera: f"{group.name}/obs/{camera}_depth" for camera in cameras if f"{camera}_depth" in group["obs"]}
        fps = _fps(told, path) or how.fps
        states, flipped = _states(group["obs"], how, path)
        return Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task=_task(group, told, path, how),
            fps=fps,
            timestamps=np.arange(len(actions)) / fps,
            actions=actions,
            states=states,
            cameras={camera: H5Frames(path, key, how.turned) for camera, key in cameras.items()},
            depth={camera: H5Depths(path, key, how.turned) for camera, key in depths.items() if self.depth},
            meta={
                "source": how.name,
                "file": ref.location["file"],
                "demo": ref.location["demo"],
                "environment": str(told.get("env_name", "")),
                "notes": {"flipped": flipped} if flipped else {},
                "actions": Layout("delta", held=_grippers(actions.shape[1])).to_json(),
            },
        )

    def check_pictures(self) -> None:
        """Raises :class:`SourceError` where the first demo that can be read has no pictures: then none has."""
        for file in self.files:
            try:
                demos = self._demos(self.folder / file)
                with open_file(self.folder / file) as opened:
                    observed = opened[f"data/{demos[0]}/obs"] if demos else {}
                    if demos and not picture_keys(observed, self.convention):
                        ending = self.convention.endings[0]
                        raise SourceError(f"{self.folder / file}: data/{demos[0]}/obs has no *{ending}; {_RENDER}")
                return
            except (EpisodeError, KeyError):
                continue  # its episodes are listed, and refused one by one

    def _demos(self, path: Path) -> list[str]:
        """The demos of a file in the order of their numbers.

        Raises:
            SourceError: it has no such filter.
            EpisodeError: it cannot be read.
        """
        with open_file(path) as opened:
            if not isinstance(own(opened, "data", path), h5py.Group):
                raise EpisodeError(f"{path}: has no group data, so it is no {self.convention.name} file; take it away")
            if not len(opened["data"]):
                raise EpisodeError(f"{path}: its group data has no demos; take it away or fetch it again")
            if not self.filter:
                return sorted(opened["data"], key=_number)
            masks = opened.get("mask", {})
            if self.filter not in masks:
                hint = did_you_mean(self.filter, masks)
                raise SourceError(f"{path}: no mask/{self.filter}{hint}; it has {', '.join(masks) or 'no filters'}")
            listed = masks[self.filter][()]
        return sorted((name.decode() if isinstance(name, bytes) else str(name) for name in listed), key=_number)


def picture_keys(observed: Any, how: Convention) -> dict[str, str]:
    """The key of each camera's pictures in a group ``obs``, by the camera's name."""
    return {
        key.removesuffix(ending): key
        for ending in how.endings
        for key in observed
        if key.endswith(ending) and isinstance(observed[key], h5py.Dataset)
    }


def _states(observed: Any, how: Convention, path: Path) -> tuple[Float32[np.ndarray, "N S"] | None, dict[str, int]]:
    """What the robot measured, and in how many rows of which field a quaternion's sign was turned back."""
    parts, flipped = [], {}
    for key in (key for key in how.states if key in observed):
        part = rows(observed, key, path)
        if key in how.quaternions and part.shape[1] == 4:
            mended = unflipped(part)
            flipped[key] = int((mended != part).any(1).sum())
            part = mended
        parts.append(part)
    for part in parts:
        if len(part) != len(parts[0]):
            told = f"{path}: states below {observed.name} have {len(parts[0])} and {len(part)} rows; leave it out"
            raise EpisodeError(told, "length")
    return np.concatenate(parts, axis=1) if parts else None, {key: count for key, count in flipped.items() if count}


def _told(group: Any, path: Path) -> dict[str, Any]:
    """``env_args`` and ``problem_info`` of a file, which are JSON."""
    told: dict[str, Any] = {}
    for name in ("env_args", "problem_info"):
        text = attribute(group, name, path)
        try:
            values = json.loads(text) if text else {}
        except (TypeError, ValueError) as error:
            raise EpisodeError(f"{path}: data.{name} is not JSON ({error}); mend the attribute") from error
        told |= values if isinstance(values, dict) else {}
    return told


def _fps(told: dict[str, Any], path: Path) -> float:
    """What the simulator was run at; 0 where the file does not say."""
    settings = told.get("env_kwargs")
    fps = settings.get("control_freq", 0) if isinstance(settings, dict) else 0
    if not isinstance(fps, int | float) or not 0 <= fps <= MAX_FPS:
        raise EpisodeError(f"{path}: control_freq in data.env_args is {fps!r}, should be steps per second; mend it")
    return float(fps)


def _task(group: Any, told: dict[str, Any], path: Path, how: Convention) -> str:
    """The instruction where there is one, otherwise the environment's name; LIBERO's files are named after the task."""
    told_here = attribute(group, "ep_meta", path)
    try:
        spoken = json.loads(told_here).get("lang") if told_here else None
    except (AttributeError, TypeError, ValueError):
        spoken = None
    spoken = spoken or told.get("language_instruction")
    if isinstance(spoken, list):
        spoken = spoken[0] if spoken else ""
    if spoken:
        return str(spoken).strip('" ')
    return path.stem.removesuffix("_demo").replace("_", " ") if how.after else str(told.get("env_name", ""))


def _grippers(width: int) -> tuple[int, ...]:
    """The last dimension of each arm's seven; other robots' only the last."""
    return tuple(range(6, width, 7)) if width % 7 == 0 else (width - 1,)


def _number(demo: str) -> tuple[int, str]:
    """``demo_10`` comes after ``demo_9``."""
    digits = demo.rpartition("_")[2]
    return (int(digits) if digits.isdecimal() else -1), demo
