"""One recorded episode of any data set, before it becomes clips, and what a reader of a format has to offer.

A reader (:class:`EpisodeSource`) lists its episodes without decoding a picture, and reads one of them at a time; the
pictures stay on disk until somebody asks for them, so memory does not grow with the data set.

Axes: N recorded frames, H×W pixels, A action dimensions, S state dimensions.
"""

import errno
import hashlib
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Float32, UInt8

from rsjax.errors import UserError
from rsjax.files import safe_id as safe_id  # readers import it from here

_WHOLE, _EDGE = 2**18, 2**13  # bytes: files up to the first go whole into a fingerprint, others with both ends
MAX_PIXELS = 2**26  # of one picture: more is a damaged header, not a camera
MAX_FPS = 10_000.0  # more is a mistake, not a camera


class SourceError(UserError):
    """A data set that cannot be read at all. The message names the file, the field and the cure."""


class EpisodeError(UserError):
    """One episode cannot be read: the message names the file, the field and the cure. A run quarantines it.

    Attributes:
        kind: one of :data:`rsjax.ingest.checks.KINDS`.
        option: the command's option that rules the episode out, such as ``--camera``; "" where none does.
    """

    def __init__(self, message: str, kind: str = "unreadable", option: str = "") -> None:
        super().__init__(message)
        self.kind = kind
        self.option = option


@dataclass(frozen=True)
class Segment:
    """A part of an episode that the data set itself names.

    Attributes:
        start: its first frame.
        end: the frame after its last, > start.
        text: what is done in it.
        skill: the data set's word for it, "" where there is none.
    """

    start: int
    end: int
    text: str
    skill: str = ""


class Frames(Protocol):
    """The pictures of one camera, decoded when they are asked for. Can be sent to other processes."""

    def __len__(self) -> int: ...

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        """These pictures, 0–255, RGB, upright; any order, repeats allowed.

        Raises:
            EpisodeError: one of them cannot be read.
        """
        ...


class Depths(Protocol):
    """The depth maps of one camera, as :class:`Frames`."""

    def __len__(self) -> int: ...

    def read(self, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
        """These maps, in metres along the optical axis; 0 where the camera measured nothing.

        Raises:
            EpisodeError: one of them cannot be read.
        """
        ...


@dataclass(frozen=True)
class EpisodeRef:
    """Where an episode is, picklable and JSON-ready: it travels to worker processes.

    Attributes:
        id: unique within the source, safe as a file name (see :func:`safe_id`).
        fingerprint: 16 hex digits of what it would be read from.
        location: what the source's ``read`` needs.
    """

    id: str
    fingerprint: str
    location: dict[str, Any]


@dataclass(frozen=True)
class Episode:
    """One episode; every array has a row for each frame.

    Attributes:
        id: unique within the source, safe as a file name.
        fingerprint: 16 hex digits of what it was read from.
        task: what the robot is asked to do; "" where the data set names none.
        fps: frames per second, > 0.
        timestamps: seconds from the first frame, increasing.
        actions: row t is what led from frame t-1 into frame t, in the data set's own units; row 0 is zeros.
        states: what the robot measured of itself at each frame; None where it was not recorded.
        cameras: pictures by the camera's name.
        depth: depth maps by the same names; empty where none was recorded.
        segments: the data set's own, in order.
        meta: JSON-ready; ``meta["actions"]`` is the :class:`rsjax.ingest.actions.Layout` of the actions.
    """

    id: str
    fingerprint: str
    task: str
    fps: float
    timestamps: Float[np.ndarray, " N"]
    actions: Float32[np.ndarray, "N A"]
    states: Float32[np.ndarray, "N S"] | None
    cameras: Mapping[str, Frames]
    depth: Mapping[str, Depths] = field(default_factory=dict)
    segments: tuple[Segment, ...] = ()
    meta: dict[str, Any] = field(default_factory=dict)


class EpisodeSource(Protocol):
    """A data set of one format. Can be sent to other processes."""

    name: str

    def episodes(self) -> Iterator[EpisodeRef]:
        """Every episode, in a fixed order, without reading pictures.

        Raises:
            SourceError: the data set cannot be listed.
        """
        ...

    def read(self, ref: EpisodeRef) -> Episode:
        """One episode.

        Raises:
            EpisodeError: it cannot be read, or its parts do not fit together.
        """
        ...


def checked(episode: Episode, where: Path | str) -> Episode:
    """The same episode, if it keeps what :class:`Episode` promises.

    Args:
        where: the file that messages name.

    Raises:
        EpisodeError: no frames, rows or pictures that are not as many as the timestamps, values that are not finite,
            or time that does not increase.
    """
    count = len(episode.timestamps)
    if count == 0:
        raise EpisodeError(f"{where}: episode {episode.id} has no frames; leave it out", "length")
    if not episode.cameras:
        raise EpisodeError(f"{where}: episode {episode.id} has no camera; leave it out or add its pictures", "camera")
    arrays = {"actions": episode.actions} | ({} if episode.states is None else {"states": episode.states})
    lengths = {name: len(array) for name, array in arrays.items()}
    lengths |= {f"camera {name}": len(frames) for name, frames in episode.cameras.items()}
    lengths |= {f"depth {name}": len(maps) for name, maps in episode.depth.items()}
    for name, length in lengths.items():
        if length != count:
            raise EpisodeError(f"{where}: {name} has {length} rows, timestamps {count}; mend or leave it out", "length")
    for name, array in ({"timestamps": episode.timestamps} | arrays).items():
        if not np.isfinite(array).all():
            row = int(np.flatnonzero(~np.isfinite(array.reshape(count, -1)).all(1))[0])
            told = f"{where}: {name} of frame {row} is not finite; mend the value or leave the episode out"
            raise EpisodeError(told, "not-finite")
    if (back := np.flatnonzero(np.diff(episode.timestamps) <= 0)).size:
        told = f"{where}: timestamps do not increase at frame {back[0] + 1}; mend them or leave it out"
        raise EpisodeError(told, "time")
    if not np.isfinite(episode.fps) or episode.fps <= 0:
        raise EpisodeError(f"{where}: fps is {episode.fps}; it must be positive", "time")
    return episode


def plain(path: Path) -> Path:
    """The same path, unless it is a pipe or a device: opening one may wait for ever, and reading it may never end.

    Raises:
        OSError: it is.
    """
    mode = path.stat().st_mode
    if stat.S_ISFIFO(mode) or stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
        raise OSError(errno.EINVAL, "a pipe or device, not a file", str(path))
    return path


def _bytes(text: str) -> bytes:
    """UTF-8; of a file's name also the bytes that are none."""
    return text.encode("utf-8", "surrogatepass")


def fingerprint(paths: Sequence[Path], *more: object) -> str:
    """16 hex digits of files and values. A missing file counts too; folders do not, so a data set may be moved.

    Of files above 256 KiB only size, date and both ends count: a data set's videos are too many to be read for this.
    """
    digest = hashlib.sha256(repr(more).encode())
    for path in paths:
        digest.update(_file_digest(*_stamp(path)))
    return digest.hexdigest()[:16]


def _stamp(path: Path) -> tuple[Path, int, int]:
    try:
        status = path.stat()
    except OSError:
        return path, -1, 0
    return path, status.st_size, status.st_mtime_ns


@lru_cache(maxsize=1024)  # one file may hold hundreds of episodes
def _file_digest(path: Path, size: int, modified: int) -> bytes:
    large = size > _WHOLE
    digest = hashlib.sha256(_bytes(f"{path.name} {size} {modified if large else ''}"))
    try:
        with plain(path).open("rb") as file:
            digest.update(file.read(_EDGE if large else _WHOLE))
            if large:
                file.seek(size - _EDGE)
                digest.update(file.read(_EDGE))
    except OSError as error:
        digest.update(str(error.errno).encode())
    return digest.digest()
