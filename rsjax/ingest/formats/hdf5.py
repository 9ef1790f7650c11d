"""Arrays of an HDF5 file as pictures, depth maps and rows of numbers, with errors that name file and data set."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.ingest.episode import MAX_PIXELS, EpisodeError, plain
from rsjax.ingest.formats.files import MAX_CELLS

_MOST_CHUNK = 2**30  # bytes that HDF5 unpacks at once, whatever of them is asked for
_CURE = "fetch the file again or leave the episode out"


@contextmanager
def open_file(path: Path) -> Iterator[h5py.File]:
    """The file, to be read. A damaged part shows itself when it is read: that, too, is an error of the file.

    Raises:
        EpisodeError: it is missing, truncated or no HDF5.
    """
    try:
        with h5py.File(plain(path), "r", locking=False) as file:
            yield file
    except FileNotFoundError as error:
        raise EpisodeError(f"{path}: missing; {_CURE}") from error
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:  # how h5py reports damage
        reason = " ".join(str(error).split())[:200]
        raise EpisodeError(f"{path}: not a readable HDF5 file ({reason}); {_CURE}") from error


def own(group: Any, key: str, path: Path) -> Any:
    """What is called ``key``, None where nothing is. HDF5 can point into any file of the machine: that is refused.

    Raises:
        EpisodeError: it lies in another file, or cannot be unpacked in parts.
    """
    found = group.get(key)
    if found is None:
        return None
    name = f"{group.name.rstrip('/')}/{key}"
    elsewhere = found.file.filename != group.file.filename
    if elsewhere or (isinstance(found, h5py.Dataset) and (found.external or found.is_virtual)):
        raise EpisodeError(f"{path}: {name} lies in another file; copy it into this one or leave the episode out")
    chunks = found.chunks if isinstance(found, h5py.Dataset) else None
    if chunks and (size := math.prod(chunks) * found.dtype.itemsize) > _MOST_CHUNK:
        raise EpisodeError(f"{path}: {name} has chunks of {size} bytes; {_CURE}")
    return found


class H5Frames:
    """Pictures in an HDF5 file, as :class:`rsjax.ingest.episode.Frames`.

    Args:
        path: the file.
        key: of the data set, uint8 [N, H, W, 3].
        turned: whether they are upside down, by half a turn.

    Raises:
        EpisodeError: the data set is not like that.
    """

    def __init__(self, path: Path, key: str, turned: bool = False) -> None:
        self._path, self._key, self._turned = path, key, turned
        shape, kind = _outline(path, key)
        if kind != np.uint8 or len(shape) != 4 or shape[3] != 3 or not 0 < shape[1] * shape[2] <= MAX_PIXELS:
            raise EpisodeError(f"{path}: {key} is {kind} {shape}, should be uint8 (N, H, W, 3); render it again")
        self._count = int(shape[0])

    def __len__(self) -> int:
        return self._count

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        """These pictures, upright; :class:`EpisodeError` where the file is damaged."""
        pictures = _picked(self._path, self._key, indices)
        return np.ascontiguousarray(pictures[:, ::-1, ::-1]) if self._turned else pictures


class H5Depths:
    """Depth maps in an HDF5 file, as :class:`rsjax.ingest.episode.Depths`.

    Args:
        path: the file.
        key: of the data set, floats [N, H, W] or [N, H, W, 1] in metres.
        turned: as in :class:`H5Frames`.

    Raises:
        EpisodeError: the data set is not like that.
    """

    def __init__(self, path: Path, key: str, turned: bool = False) -> None:
        self._path, self._key, self._turned = path, key, turned
        shape, kind = _outline(path, key)
        possible = len(shape) in (3, 4) and shape[3:] in ((), (1,)) and 0 < shape[1] * shape[2] <= MAX_PIXELS
        if kind.kind != "f" or not possible:
            raise EpisodeError(f"{path}: {key} is {kind} {shape}, should be floats (N, H, W); render it again")
        self._count = int(shape[0])

    def __len__(self) -> int:
        return self._count

    def read(self, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
        """These maps, upright; :class:`EpisodeError` where the file is damaged."""
        maps = _picked(self._path, self._key, indices).astype(np.float32)
        maps = maps[..., 0] if maps.ndim == 4 else maps
        return np.ascontiguousarray(maps[:, ::-1, ::-1]) if self._turned else maps


def rows(group: Any, key: str, path: Path) -> Float32[np.ndarray, "N n"]:
    """A data set of numbers, one row for each frame.

    Raises:
        EpisodeError: there is none, or it holds something else.
    """
    found = own(group, key, path)
    name = f"{group.name}/{key}"
    if not isinstance(found, h5py.Dataset):
        raise EpisodeError(f"{path}: has no {name}; leave the episode out")
    if 0 in found.shape[1:] or found.dtype.kind not in "fiu" or found.ndim not in (1, 2) or found.size > MAX_CELLS:
        raise EpisodeError(f"{path}: {name} is {found.dtype} {found.shape}, should be numbers (N, n); {_CURE}")
    with np.errstate(over="ignore"):  # what float32 cannot hold is infinite, which is told
        values = found[()].astype(np.float32)
    return values[:, None] if values.ndim == 1 else values


def attribute(group: Any, name: str, path: Path) -> Any:
    """An attribute, text decoded; None where there is none."""
    value = group.attrs.get(name)
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def _outline(path: Path, key: str) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of a data set."""
    with open_file(path) as file:
        found = own(file, key, path)
        if not isinstance(found, h5py.Dataset) or found.shape is None:
            raise EpisodeError(f"{path}: {key} is no array; render it again or leave the episode out")
        return found.shape, found.dtype


def _picked(path: Path, key: str, indices: Sequence[int]) -> np.ndarray:
    wanted, places = np.unique(np.asarray(indices, np.int64), return_inverse=True)  # h5py wants them increasing
    with open_file(path) as file:
        return file[key][wanted][places]
