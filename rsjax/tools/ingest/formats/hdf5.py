"""Reads arrays of HDF5 files as pictures, depth maps and rows of numbers; errors name file and data set.

It also reads what a file of robomimic, robosuite or LIBERO says about its simulator, in attributes that are JSON.
"""

import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from jaxtyping import Float32

from rsjax.clip import words_of
from rsjax.tools.ingest.actions import Kind
from rsjax.tools.ingest.episode import LEAVE_OUT, MAX_FPS, MAX_PIXELS, EpisodeError, data_file, reason
from rsjax.tools.ingest.formats.files import MAX_CELLS

_MOST_CHUNK = 2**30  # bytes of a chunk, which HDF5 unpacks as a whole however few of them are read
Stored = Literal["upright", "bottom first", "half turn"]  # how a file stores its pictures


@contextmanager
def open_file(path: Path) -> Iterator[h5py.File]:
    """Opens a file for reading. Damage that shows only when a part is read also becomes an error of the file.

    Raises:
        EpisodeError: the file is missing, truncated or not HDF5.
    """
    try:
        data_file(path)
    except OSError as error:
        raise EpisodeError.at(path, reason(error)) from error
    try:
        with h5py.File(path, "r", locking=False) as file:
            yield file
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:  # how h5py reports damage
        raise EpisodeError.at(path, f"not a readable HDF5 file ({' '.join(str(error).split())[:200]})") from error


def member(group: Any, key: str, path: Path) -> Any:
    """Returns the member ``key`` of a group; None if there is none. HDF5 links into other files are refused.

    Raises:
        EpisodeError: the member lies in another file, or its chunks are too large to be unpacked.
    """
    entry = group.get(key)
    if entry is None:
        return None
    name = f"{group.name.rstrip('/')}/{key}"
    elsewhere = entry.file.filename != group.file.filename
    if elsewhere or (isinstance(entry, h5py.Dataset) and (entry.external or entry.is_virtual)):
        raise EpisodeError.at(path, f"{name} lies in another file", f"copy it into this one or {LEAVE_OUT}")
    chunks = None
    if isinstance(entry, h5py.Dataset):
        chunks = entry.chunks
    if chunks and (size := math.prod(chunks) * entry.dtype.itemsize) > _MOST_CHUNK:
        raise EpisodeError.at(path, f"{name} has chunks of {size} bytes")
    return entry


def rows(group: Any, key: str, path: Path) -> Float32[np.ndarray, "N n"]:
    """Reads a data set of numbers, one row for each frame.

    Raises:
        EpisodeError: there is no such data set, or it contains something else.
    """
    data = member(group, key, path)
    name = f"{group.name}/{key}"
    if not isinstance(data, h5py.Dataset):
        raise EpisodeError.at(path, f"has no {name}", LEAVE_OUT)
    if 0 in data.shape[1:] or data.dtype.kind not in "fiu" or data.ndim not in (1, 2) or data.size > MAX_CELLS:
        raise EpisodeError.at(path, f"{name} is {data.dtype} {data.shape}, should be numbers (N, n)")
    with np.errstate(over="ignore"):  # values beyond float32 become infinite, which is refused later
        values = data[()].astype(np.float32)
    if values.ndim == 1:
        return values[:, None]
    return values


class H5Frames:
    """Pictures in an HDF5 file, as :class:`rsjax.tools.ingest.episode.Frames`, or depth maps, as ``Depths``.

    Args:
        path: the file.
        key: key of the data set: pictures, uint8 [N, H, W, 3]; depth maps, floats [N, H, W] or [N, H, W, 1] in metres.
        stored: how the file stores them: upright, with the bottom row first, or rotated by half a turn.
        depth: whether they are depth maps.

    Raises:
        EpisodeError: the data set has another shape or type.
    """

    def __init__(self, path: Path, key: str, stored: Stored = "upright", depth: bool = False) -> None:
        self._path = path
        self._key = key
        self._stored = stored
        self._depth = depth
        with open_file(path) as file:
            data = member(file, key, path)
            if not isinstance(data, h5py.Dataset) or data.shape is None:
                raise EpisodeError.at(path, f"{key} is not an array", f"render it again or {LEAVE_OUT}")
            shape = data.shape
            kind = data.dtype
        if depth:
            fits = kind.kind == "f" and len(shape) in (3, 4) and shape[3:] in ((), (1,))
            expected = "floats (N, H, W)"
        else:
            fits = kind == np.uint8 and len(shape) == 4 and shape[3] == 3
            expected = "uint8 (N, H, W, 3)"
        if not fits or not 0 < shape[1] * shape[2] <= MAX_PIXELS:
            raise EpisodeError.at(path, f"{key} is {kind} {shape}, should be {expected}", "render it again")
        self._count = int(shape[0])

    def __len__(self) -> int:
        return self._count

    def read(self, indices: Sequence[int]) -> np.ndarray:
        """Returns these pictures or maps, upright; :class:`EpisodeError` if the file is damaged."""
        wanted, order = np.unique(np.asarray(indices, np.int64), return_inverse=True)  # h5py needs increasing indices
        with open_file(self._path) as file:
            pictures = file[self._key][wanted][order]
        if self._depth:
            pictures = pictures.reshape(pictures.shape[:3]).astype(np.float32)
        if self._stored == "upright":
            return pictures
        columns = slice(None, None, -1 if self._stored == "half turn" else 1)
        return np.ascontiguousarray(pictures[:, ::-1, columns])


def attribute(group: Any, name: str) -> Any:
    """Returns an attribute, with text decoded; None if there is none."""
    value = group.attrs.get(name)
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value


def settings_of(group: Any, path: Path) -> dict[str, Any]:
    """Returns ``env_args``, ``env_info`` (robosuite's own) and ``problem_info`` of a file.

    Args:
        group: the file's group ``data``.
        path: the file.

    Raises:
        EpisodeError: one of them is not JSON.
    """
    settings: dict[str, Any] = {}
    for name in ("env_info", "env_args", "problem_info"):
        text = attribute(group, name)
        try:
            values = json.loads(text or "{}")
        except (TypeError, ValueError, RecursionError) as error:
            raise EpisodeError.at(path, f"data.{name} is not JSON ({error})", "mend the attribute") from error
        if isinstance(values, dict):
            settings |= values
    return settings


def fps_of(settings: dict[str, Any], path: Path) -> float:
    """Returns the rate of the simulator; 0 if the file does not say.

    Raises:
        EpisodeError: the rate is impossible.
    """
    arguments = settings.get("env_kwargs")
    fps = 0
    if isinstance(arguments, dict):
        fps = arguments.get("control_freq", 0)
    if not isinstance(fps, int | float) or not 0 <= fps <= MAX_FPS:
        raise EpisodeError.at(path, f"control_freq in data.env_args is {fps!r}, should be steps per second", "mend it")
    return float(fps)


def kind_of(settings: dict[str, Any]) -> Kind:
    """Returns the kind of the arms' commands: targets if robosuite's controller settings, old or new, say so."""
    controllers = [settings.get("controller_configs")]  # where robosuite's own files have them
    arguments = settings.get("env_kwargs")
    if isinstance(arguments, dict):
        controllers.append(arguments.get("controller_configs"))
    text = json.dumps(controllers)
    if '"control_delta": false' in text or '"input_type": "absolute"' in text:
        return "absolute"
    return "delta"


def instruction_of(group: Any, settings: dict[str, Any]) -> str:
    """Returns the instruction of a demo, or of its file; "" if there is none."""
    text = attribute(group, "ep_meta")
    try:
        instruction = json.loads(text or "{}").get("lang")
    except (AttributeError, TypeError, ValueError, RecursionError):
        instruction = None
    instruction = instruction or settings.get("language_instruction")
    if isinstance(instruction, list):
        if instruction:
            instruction = instruction[0]
        else:
            instruction = ""
    return words_of(instruction).strip('" ')
