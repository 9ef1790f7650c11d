"""Arrays of an HDF5 file as pictures, depth maps and rows of numbers, with errors that name file and data set."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.data.episode import MAX_PIXELS, EpisodeError

MAX_NUMBERS = 2**24  # numbers of one array that are read at once
_CURE = "fetch the file again or leave the episode out"


@contextmanager
def open_file(path: Path) -> Iterator[h5py.File]:
    """The file, to be read. A damaged part shows itself when it is read: that, too, is an error of the file.

    Raises:
        EpisodeError: it is missing, truncated or no HDF5.
    """
    try:
        with h5py.File(path, "r", locking=False) as file:
            yield file
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:  # how h5py reports damage
        reason = " ".join(str(error).split())[:200]
        raise EpisodeError(f"{path}: not a readable HDF5 file ({reason}); {_CURE}") from error


class H5Frames:
    """Pictures in an HDF5 file, as :class:`rsjax.data.episode.Frames`.

    Args:
        path: the file.
        key: of the data set, uint8 [N, H, W, 3].
        turned: whether they are upside down, by half a turn.

    Raises:
        EpisodeError: the data set is not like that.
    """

    def __init__(self, path: Path, key: str, turned: bool = False) -> None:
        self._path, self._key, self._turned = path, key, turned
        with open_file(path) as file:
            shape, kind = file[key].shape, file[key].dtype
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
    """Depth maps in an HDF5 file, as :class:`rsjax.data.episode.Depths`.

    Args:
        path: the file.
        key: of the data set, floats [N, H, W] or [N, H, W, 1] in metres.
        turned: as in :class:`H5Frames`.

    Raises:
        EpisodeError: the data set is not like that.
    """

    def __init__(self, path: Path, key: str, turned: bool = False) -> None:
        self._path, self._key, self._turned = path, key, turned
        with open_file(path) as file:
            shape, kind = file[key].shape, file[key].dtype
        if kind.kind != "f" or shape[3:] not in ((), (1,)) or not 0 < np.prod(shape[1:3]) <= MAX_PIXELS:
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
    found = group.get(key)
    name = f"{group.name}/{key}"
    if not isinstance(found, h5py.Dataset):
        raise EpisodeError(f"{path}: has no {name}; leave the episode out")
    if 0 in found.shape[1:] or found.dtype.kind not in "fiu" or found.ndim not in (1, 2) or found.size > MAX_NUMBERS:
        raise EpisodeError(f"{path}: {name} is {found.dtype} {found.shape}, should be numbers (N, n); {_CURE}")
    values = found[()].astype(np.float32)
    return values[:, None] if values.ndim == 1 else values


def attribute(group: Any, name: str, path: Path) -> Any:
    """An attribute, text decoded; None where there is none."""
    value = group.attrs.get(name)
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def _picked(path: Path, key: str, indices: Sequence[int]) -> np.ndarray:
    wanted, places = np.unique(np.asarray(indices, np.int64), return_inverse=True)  # h5py wants them increasing
    with open_file(path) as file:
        return file[key][wanted][places]
