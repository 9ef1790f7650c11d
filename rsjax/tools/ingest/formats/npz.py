"""Reads a folder of ``.npz`` files, one for each episode, as ``np.savez`` writes them, without pickle.

==============  =======================  ===============================================================================
``frames``      uint8 [T, H, W, 3]       RGB, upright
``actions``     [T, A] or [T-1, A]       see ``after``
``depth``       float or uint16 [T,H,W]  optional: metres or, as whole numbers, millimetres; 0: not measured
``state``       [T, S]                   optional: what the robot measured of itself
``timestamps``  [T]                      optional: seconds, in place of ``fps``
``success``     one value or [T]         optional: whether the task is done
``fps``         one number               frames per second
``task``        text                     optional
``kind``        text                     optional: ``absolute`` or ``delta``, see ``actions.ActionLayout``
==============  =======================  ===============================================================================
"""

import math
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.files import safe_id
from rsjax.tools.ingest.actions import Kind, align_actions, check_layout, layout_of
from rsjax.tools.ingest.episode import (
    MAX_FPS,
    MAX_PIXELS,
    Episode,
    EpisodeError,
    EpisodeRef,
    SourceError,
    checked,
    data_file,
    fingerprint,
    reason,
)
from rsjax.tools.ingest.formats.files import MAX_CELLS, inside, location_of

_MOST_BYTES = 2**31  # largest size of an episode's pictures, which are in memory while they are read
_SAVE = "save the file again"


@dataclass(frozen=True)
class NpzConfig:
    """The options of :func:`open_source`."""

    frames: str
    actions: str
    task: str
    fps: float
    after: bool
    kind: str
    held: tuple[int, ...] | None
    quaternions: tuple[int, ...]
    angles: tuple[int, ...] = ()


def open_source(
    path: Path,
    *,
    frames: str = "frames",
    actions: str = "actions",
    task: str = "",
    fps: float = 0.0,
    after: bool = False,
    kind: Kind | None = None,
    held: Sequence[int] | None = None,
    quaternions: Sequence[int] = (),
    angles: Sequence[int] = (),
) -> "NpzFolder":
    """Opens a folder of episodes, or a single one.

    Args:
        frames: the name of the array of pictures in the files, such as ``image``.
        actions: the name of the array of actions, such as ``action``.
        task: the task in files that name none.
        fps: frames per second in files that have neither ``fps`` nor ``timestamps``.
        after: whether each frame was recorded after the action of its row.
        kind: kind of the actions in files that do not say; see ``actions.ActionLayout``.
        held: likewise.
        quaternions: likewise.
        angles: likewise.

    Raises:
        SourceError: there are no files, or ``fps`` is not possible.
    """
    if not 0 <= fps <= MAX_FPS:
        raise SourceError(f"npz: option fps is {fps}; it must be above 0 and at most {MAX_FPS:g}")
    if path.is_file():
        folder = path.parent
        files = [path]
    else:
        folder = path
        files = sorted(file for file in path.glob("**/*.npz") if file.is_file())
    if not files:
        raise SourceError(f"{path}: no *.npz files; give the folder with them")
    if held is None:
        stay = None
    else:
        stay = tuple(held)
    settings = NpzConfig(frames, actions, task, float(fps), after, kind or "", stay, tuple(quaternions), tuple(angles))
    return NpzFolder(folder, tuple(str(file.relative_to(folder)) for file in files), settings)


@dataclass(frozen=True)
class NpzFolder:
    """See :class:`rsjax.tools.ingest.episode.EpisodeSource`.

    Attributes:
        folder: the folder to which the files' names are relative.
        files: the files, in order.
        settings: the options.
    """

    name = "npz"
    folder: Path
    files: tuple[str, ...]
    settings: NpzConfig

    def episodes(self) -> Iterator[EpisodeRef]:
        """Lists the files by name."""
        settings = asdict(self.settings)
        if not self.settings.angles:  # so that the fingerprints of data sets without angles stay as they were
            del settings["angles"]
        for file in self.files:
            mark = fingerprint([self.folder / file], file, settings)
            yield EpisodeRef(safe_id(file.removesuffix(".npz").replace("/", "-")), mark, {"file": file})

    def read(self, ref: EpisodeRef) -> Episode:
        """Reads one file; its pictures are unpacked when they are read."""
        path = inside(self.folder, location_of(ref)["file"])
        how = self.settings
        frames = NpzFrames(path, how.frames)
        count = len(frames)
        commands = _numbers(path, how.actions)
        if not how.after and len(commands) == count - 1:  # only the last row, which leads into no frame, is missing
            commands = np.concatenate([commands, commands[-1:]])
        kind = _text(path, "kind") or how.kind
        if kind not in ("absolute", "delta", ""):
            raise EpisodeError.at(path, f"kind is {kind!r}, should be 'absolute' or 'delta'", _SAVE)
        actions = align_actions(commands, how.after)
        if _header(path, "state"):
            states = _numbers(path, "state")
        else:
            states = None
        declared: dict[str, Kind] = {"absolute": "absolute", "delta": "delta"}
        layout = layout_of(actions, declared.get(kind), how.held, how.quaternions, how.angles, (), states)
        check_layout(layout, commands.shape[1], path)
        times = _times(path, count, how.fps)
        meta = {"source": "npz", "file": ref.location["file"], "actions": layout.to_json()}
        success = _array(path, "success")
        if success is not None:
            if success.shape not in ((), (count,)) or success.dtype.kind not in "biuf":
                problem = f"success is {success.dtype} {success.shape}, should be one value or ({count},)"
                raise EpisodeError.at(path, problem, _SAVE)
            meta["success"] = success.astype(bool).tolist()
        episode = Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task=(_text(path, "task") or how.task).strip(),
            fps=1 / float(np.median(np.diff(times))) if count > 1 and (np.diff(times) > 0).all() else 1.0,
            timestamps=times - times[:1],
            actions=actions,
            states=states,
            cameras={"main": frames},
            depth={"main": NpzFrames(path, "depth", depth=True)} if _header(path, "depth") else {},
            meta=meta,
        )
        return checked(episode, path)


class NpzFrames:
    """An array of pictures, as :class:`rsjax.tools.ingest.episode.Frames`, or of depth maps, as ``Depths``.

    Args:
        path: the file.
        name: name of the array.
        depth: whether it contains depth maps.

    Raises:
        EpisodeError: there is no such array, or it has another shape or type.
    """

    def __init__(self, path: Path, name: str, depth: bool = False) -> None:
        self._path = path
        self._name = name
        self._depth = depth
        shape, dtype = _header(path, name) or ((), "none")
        if depth:
            fits = (dtype == np.uint16 or dtype.kind == "f") and len(shape) == 3  # type: ignore
            expected = "floats or uint16 (T, H, W)"
        else:
            fits = dtype == np.uint8 and len(shape) == 4 and shape[3] == 3
            expected = "uint8 (T, H, W, 3)"
        if not fits or not 0 < shape[1] * shape[2] <= MAX_PIXELS:
            raise EpisodeError.at(path, f"{name} is {dtype} {shape}, should be {expected}", _SAVE)
        self._count = int(shape[0])

    def __len__(self) -> int:
        return self._count

    def read(self, indices: Sequence[int]) -> np.ndarray:
        """Returns these pictures or maps; :class:`EpisodeError` if the file is damaged."""
        try:
            status = self._path.stat()
        except OSError as error:
            raise EpisodeError.at(self._path, reason(error)) from error
        whole = _unpacked(self._path, self._name, status.st_size, status.st_mtime_ns)
        rows = whole[np.asarray(indices, np.int64)]
        if self._depth:
            return rows.astype(np.float32) * np.float32(0.001 if rows.dtype == np.uint16 else 1)
        return rows


@lru_cache(maxsize=2)  # an episode's pictures and depth: windows overlap, and a compressed array has no random access
def _unpacked(path: Path, name: str, size: int, modified: int) -> np.ndarray:
    array = _array(path, name, _MOST_BYTES)
    if array is None:
        raise EpisodeError.at(path, f"has no {name}")
    return array


def _header(path: Path, name: str) -> tuple[tuple[int, ...], np.dtype[Any]] | None:
    """Returns shape and type of an array; None if there is none.

    Raises:
        EpisodeError: the file is damaged, or the array is of pickled objects.
    """
    try:
        with zipfile.ZipFile(data_file(path)) as archive:
            if f"{name}.npy" not in archive.namelist():
                return None
            with archive.open(f"{name}.npy") as file:
                version = np.lib.format.read_magic(file)
                if version == (1, 0):
                    read = np.lib.format.read_array_header_1_0
                else:
                    read = np.lib.format.read_array_header_2_0
                shape, _, dtype = read(file)
    except Exception as error:  # zipfile and numpy report damage by many types of error
        raise EpisodeError.at(path, reason(error)) from error
    if dtype.hasobject:
        raise EpisodeError.at(path, f"{name} is of Python objects, which are not read", f"{_SAVE} with numbers or text")
    return shape, dtype


def _array(path: Path, name: str, most: int = 8 * MAX_CELLS) -> np.ndarray | None:
    """Reads an array, after checking its size and before allocating memory; None if there is none.

    Args:
        most: largest size of the array in bytes.

    Raises:
        EpisodeError: as :func:`_header`, or the array is larger.
    """
    if (header := _header(path, name)) is None:
        return None
    shape, dtype = header
    if (size := math.prod(shape) * dtype.itemsize) > most:
        raise EpisodeError.at(path, f"{name} has {size} bytes unpacked, more than {most}", "split the episode")
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"{name}.npy") as file:
            return np.lib.format.read_array(file, allow_pickle=False)
    except Exception as error:
        raise EpisodeError.at(path, reason(error)) from error


def _numbers(path: Path, name: str) -> np.ndarray:
    """Reads an array (T, n) or (T,) of numbers as float32 (T, n)."""
    array = _array(path, name)
    if array is None or array.dtype.kind not in "fiu" or array.ndim not in (1, 2) or not array.size:
        if array is None:
            actual = "missing"
        else:
            actual = f"{array.dtype} {array.shape}"
        raise EpisodeError.at(path, f"{name} is {actual}, should be numbers (T, n)", _SAVE)
    with np.errstate(over="ignore"):
        return array.astype(np.float32).reshape(len(array), -1)


def _times(path: Path, count: int, fps: float) -> np.ndarray:
    """Returns the time of each frame in seconds, by the file's ``timestamps``, its ``fps`` or the option."""
    times = _array(path, "timestamps")
    if times is not None:
        if times.shape != (count,) or times.dtype.kind not in "fiu":
            raise EpisodeError.at(
                path, f"timestamps are {times.dtype} {times.shape}, should be numbers ({count},)", _SAVE
            )
        return times.astype(np.float64)
    own = _array(path, "fps")
    if own is not None:
        if own.size != 1 or own.dtype.kind not in "fiu" or not 0 < float(own.reshape(())) <= MAX_FPS:
            raise EpisodeError.at(path, f"fps is {own!r:.80}, should be one number, at most {MAX_FPS:g}", _SAVE)
        fps = float(own.reshape(()))
    if not fps:
        raise EpisodeError.at(path, "does not say how fast its pictures are", "add fps to it, or say --option fps=…")
    return np.arange(count) / fps


def _text(path: Path, name: str) -> str:
    array = _array(path, name)
    if array is None:
        return ""
    if array.size != 1 or array.dtype.kind not in "US":
        raise EpisodeError.at(path, f"{name} is {array.dtype} {array.shape}, should be one text", _SAVE)
    value = array.reshape(())[()]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return str(value)
