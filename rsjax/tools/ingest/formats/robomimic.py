"""Reads robomimic HDF5 files: ``data/demo_i`` has ``actions`` and ``obs/<key>``; ``mask/<filter>`` lists demos.

``obs[t]`` was recorded before ``actions[t]``, which led to ``obs[t + 1]``. robosuite's own demos have no ``obs``, and
robomimic's downloads have no pictures in it: both are rendered from their simulator states, if the installed robosuite
has the models (:mod:`rsjax.tools.ingest.formats.rendered`). LIBERO's files have the same layout with other conventions
(:mod:`rsjax.tools.ingest.formats.libero`), so this module reads both, each by its :class:`Convention`.
"""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float32

from rsjax.clip import words_of
from rsjax.errors import did_you_mean
from rsjax.files import safe_id
from rsjax.tools.ingest.actions import ActionLayout, Kind, align_actions, check_layout, continuous_signs
from rsjax.tools.ingest.episode import LEAVE_OUT, Episode, EpisodeError, EpisodeRef, SourceError, checked, fingerprint
from rsjax.tools.ingest.formats.files import MAX_CELLS, broken, inside, location_of
from rsjax.tools.ingest.formats.hdf5 import (
    H5Frames,
    Stored,
    attribute,
    fps_of,
    instruction_of,
    kind_of,
    member,
    open_file,
    rows,
    settings_of,
)
from rsjax.tools.ingest.formats.rendered import CURE, Pictures, rendered


@dataclass(frozen=True)
class Convention:
    """The differences between the data sets of this layout.

    Attributes:
        name: name of the format.
        endings: endings of the pictures' keys below ``obs``, after the camera's name.
        states: keys below ``obs`` that make up the state, as far as a file has them.
        quaternions: those of these keys that are a quaternion, whose sign is made continuous.
        after: whether ``obs[t]`` was recorded after ``actions[t]``.
        stored: as in :class:`rsjax.tools.ingest.formats.hdf5.H5Frames`.
        buffer: whether depth maps are OpenGL's buffer, from 0 to 1, instead of metres.
        fps: frames per second if the file does not say.
    """

    name: str
    endings: tuple[str, ...]
    states: tuple[str, ...]
    quaternions: tuple[str, ...] = ()
    after: bool = False
    stored: Stored = "upright"
    buffer: bool = False
    fps: float = 20.0


ROBOMIMIC = Convention(
    "robomimic",
    ("_image",),
    ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos"),
    ("robot0_eef_quat",),
)


def open_source(
    path: Path,
    filter: str = "",
    depth: bool = False,
    size: int = 128,
    kind: Kind | None = None,
    held: Sequence[int] | None = None,
) -> "DemoSource":
    """Opens a robomimic data set.

    Args:
        path: an HDF5 file, or a folder of HDF5 files.
        filter: read only demos that ``mask/<filter>`` lists, such as ``train``.
        depth: read ``obs/<camera>_depth`` as metres. Rendered demos always have depth.
        size: side of rendered pictures in pixels, 8 to 1024.
        kind: kind of the actions (:class:`rsjax.tools.ingest.actions.ActionLayout`), in place of what the controller's
            settings say, which tools that rewrite actions often leave as they were.
        held: dimensions whose command stays in force, likewise; None: the last of each arm's seven dimensions.

    Raises:
        SourceError: there are no files, none has pictures or can be rendered, or an option is impossible.
    """
    if not 8 <= size <= 1024:
        raise SourceError(f"robomimic: option size is {size}; choose one from 8 to 1024")
    return open_demos(path, ROBOMIMIC, filter, depth, size, kind, held)


def open_demos(
    path: Path,
    convention: Convention,
    filter: str,
    depth: bool,
    size: int = 0,
    kind: Kind | None = None,
    held: Sequence[int] | None = None,
) -> "DemoSource":
    """Opens a data set of this layout. Arguments and errors as in :func:`open_source`."""
    folder = path.parent
    files = [path]
    if not path.is_file():
        folder = path
        files = sorted({file for ending in ("hdf5", "h5") for file in path.glob(f"**/*.{ending}") if file.is_file()})
    if not files:
        raise SourceError(f"{path}: no *.hdf5 files; give the {convention.name} file, or the folder with them")
    names = tuple(str(file.relative_to(folder)) for file in files)
    stay = None
    if held is not None:
        stay = tuple(held)
    source = DemoSource(folder, names, convention, filter, depth, convention.name, size, kind, stay)
    for file in files:  # if the first demo that can be read has no pictures, none has
        try:
            demos = source.demos(file)
            with open_file(file) as content:
                first = member(content, f"data/{demos[0]}", file) if demos else None
                if not isinstance(first, h5py.Group):
                    continue  # refused when it is read
                if not _picture_keys(_observed(first, file), convention):
                    try:
                        source.pictures(first, file)  # they may be rendered
                    except EpisodeError as error:
                        raise SourceError(str(error)) from error
            break
        except (EpisodeError, KeyError):
            continue  # its episodes are still listed, and refused one by one
    return source


@dataclass
class DemoSource:
    """See :class:`rsjax.tools.ingest.episode.EpisodeSource`.

    Attributes:
        folder: the folder to which the files' names are relative.
        files: the files, in order.
        convention: how to read them.
        filter: name of a filter of demos; "": all.
        depth: whether depth maps are read.
        name: the convention's name.
        size: side of rendered pictures in pixels.
        kind: kind of the actions; None: as the controller's settings say.
        held: dimensions whose command stays in force; None: the grippers'.
    """

    folder: Path
    files: tuple[str, ...]
    convention: Convention
    filter: str
    depth: bool
    name: str
    size: int = 0
    kind: Kind | None = None
    held: tuple[int, ...] | None = None

    def episodes(self) -> Iterator[EpisodeRef]:
        """Lists each file's demos by their numbers. A file that cannot be read is one entry, which ``read`` refuses.

        Several files of a folder may have the same demo: as states, as pictures, with other actions. Demos with the
        same simulator states count as one recording, so that they go to one split.
        """
        declared = (self.kind, self.held)
        for file in self.files:
            path = self.folder / file
            stem = file.rpartition(".")[0].replace("/", "-")
            try:
                demos = self.demos(path)
                with open_file(path) as content:
                    motions = [simulated_motion(content, demo, path) for demo in demos]
            except EpisodeError as error:
                yield broken(safe_id(stem), str(error))
                continue
            for demo, motion in zip(demos, motions, strict=True):
                settings = [asdict(self.convention), self.depth]
                if declared != (None, None):
                    settings.append(declared)
                mark = fingerprint([path], demo, *settings)
                identity = safe_id(f"{stem}-{demo}")
                yield EpisodeRef(identity, mark, {"file": file, "demo": demo, "recording": motion or identity})

    def read(self, ref: EpisodeRef) -> Episode:
        """Reads one demo."""
        location = location_of(ref)
        path = inside(self.folder, location["file"])
        demo = location["demo"]
        with open_file(path) as file:
            group = member(file, f"data/{demo}", path)
            if not isinstance(group, h5py.Group) or not isinstance(member(group, "obs", path), h5py.Group | None):
                raise EpisodeError.at(path, f"has no group data/{demo}", LEAVE_OUT)
            settings = settings_of(file["data"], path)
            how = self.convention
            commands = rows(group, "actions", path)
            samples = attribute(group, "num_samples")
            if samples is not None and int(samples) != len(commands):
                problem = f"{group.name}/actions has {len(commands)} rows, num_samples says {int(samples)}"
                raise EpisodeError.at(path, problem)
            cameras, depth = self.pictures(group, path)
            fps = fps_of(settings, path) or how.fps
            states, flipped = _states(group.get("obs", {}), how, path)
            width = commands.shape[1]  # a gripper is the last of each arm's seven dimensions, else the last of all
            if width % 7 == 0:
                grippers = tuple(range(6, width, 7))
            else:
                grippers = (width - 1,)
            if self.held is not None:
                grippers = self.held
            layout = ActionLayout(self.kind or kind_of(settings), held=grippers)
            check_layout(layout, width, path)
            task = instruction_of(group, settings)
            if not task and how.name == "libero":
                task = path.stem.removesuffix("_demo").replace("_", " ")  # LIBERO names files after tasks
            episode = Episode(
                id=ref.id,
                fingerprint=ref.fingerprint,
                task=task or words_of(settings.get("env_name")),
                fps=fps,
                timestamps=np.arange(len(commands)) / fps,
                actions=align_actions(commands, how.after),
                states=states,
                cameras=cameras,
                depth=depth,
                meta={
                    "source": how.name,
                    "file": ref.location["file"],
                    "demo": ref.location["demo"],
                    "environment": words_of(settings.get("env_name")),
                    "notes": {"flipped": flipped} if flipped else {},
                    "actions": layout.to_json(),
                },
            )
            return checked(episode, f"{path}: data/{demo}")

    def pictures(self, group: Any, path: Path) -> Pictures:
        """Returns the pictures and depth maps of a demo by camera, rendered if it has none.

        Raises:
            EpisodeError: pictures have another shape or type, or a demo without pictures cannot be rendered.
        """
        observed = _observed(group, path)
        stored = self.convention.stored
        keys = _picture_keys(observed, self.convention)
        if not keys and self.size:
            return rendered(group, path, self.size)
        if not keys:
            raise EpisodeError.at(path, f"{group.name}/obs has no *{self.convention.endings[0]}", CURE)
        maps = [f"{camera}_depth" for camera in keys if self.depth and f"{camera}_depth" in observed]
        for key in maps:
            if self.convention.buffer and observed[key].size and np.max(observed[key][0]) <= 1:
                problem = f"{group.name}/obs/{key} is OpenGL's depth buffer, from 0 to 1, and not in metres"
                raise EpisodeError.at(path, problem, "leave depth=true out, and estimate depth (--depth)")
        return (
            {camera: H5Frames(path, f"{observed.name}/{key}", stored) for camera, key in keys.items()},
            {key.removesuffix("_depth"): H5Frames(path, f"{observed.name}/{key}", stored, depth=True) for key in maps},
        )

    def demos(self, path: Path) -> list[str]:
        """Returns the demos of a file in the order of their numbers.

        Raises:
            SourceError: the file has no such filter.
            EpisodeError: the file cannot be read.
        """
        with open_file(path) as file:
            data = member(file, "data", path)
            if not isinstance(data, h5py.Group):
                name = self.convention.name
                raise EpisodeError.at(path, f"has no group data, so it is no {name} file", "take it away")
            if not len(data):
                raise EpisodeError.at(path, "its group data has no demos", "take it away or fetch it again")
            if not self.filter:
                return sorted(data, key=_number)
            masks = file.get("mask", {})
            if self.filter not in masks:
                hint = did_you_mean(self.filter, masks)
                raise SourceError(f"{path}: no mask/{self.filter}{hint}; it has {', '.join(masks) or 'no filters'}")
            listed = masks[self.filter][()]
        return sorted((name.decode() if isinstance(name, bytes) else str(name) for name in listed), key=_number)


def simulated_motion(content: h5py.File, demo: str, path: Path) -> str:
    """Returns a hash of the simulator's first and last state in a demo; "" if the file has none that can be read.

    Files with other pictures or actions of the same demo have the same states.
    """
    with suppress(EpisodeError, OSError, RuntimeError, KeyError, TypeError, ValueError):  # refused when it is read
        states = member(content, f"data/{demo}/states", path)
        numbers = isinstance(states, h5py.Dataset) and states.ndim == 2 and states.dtype.kind in "fiu"
        if numbers and 0 < states.size <= MAX_CELLS:
            return hashlib.sha256(states[0].tobytes() + states[-1].tobytes()).hexdigest()[:16]
    return ""


def _observed(group: Any, path: Path) -> Any:
    """Returns what a demo observed; raises :class:`EpisodeError` if that is no group."""
    observed = group.get("obs", {})
    if isinstance(observed, h5py.Dataset):
        raise EpisodeError.at(path, f"{group.name}/obs is a data set, no group", LEAVE_OUT)
    return observed


def _picture_keys(observed: Any, how: Convention) -> dict[str, str]:
    """Returns the key of each camera's pictures in a group ``obs``, by the camera's name."""
    return {
        key.removesuffix(ending): key
        for ending in how.endings
        for key in observed
        if key.endswith(ending) and isinstance(observed[key], h5py.Dataset)
    }


def _states(observed: Any, how: Convention, path: Path) -> tuple[Float32[np.ndarray, "N S"] | None, dict[str, int]]:
    """Returns the measured states, and in how many rows of which field the sign of a quaternion was flipped back."""
    parts = []
    flipped = {}
    for key in (key for key in how.states if key in observed):
        part = rows(observed, key, path)
        if key in how.quaternions and part.shape[1] == 4:
            mended = continuous_signs(part)
            if count := int((mended != part).any(1).sum()):
                flipped[key] = count
            part = mended
        parts.append(part)
        if len(part) != len(parts[0]):
            problem = f"states below {observed.name} have {len(parts[0])} and {len(part)} rows"
            raise EpisodeError.at(path, problem, "leave it out", "length")
    return np.concatenate(parts, axis=1) if parts else None, flipped


def _number(demo: str) -> tuple[int, str]:
    """Returns a key by which ``demo_10`` is sorted after ``demo_9``."""
    digits = demo.rpartition("_")[2]
    return (int(digits) if digits.isdecimal() else -1), demo
