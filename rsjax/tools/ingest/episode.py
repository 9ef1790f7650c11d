"""One recorded episode of any data set, the interface of the readers that produce it, and their errors.

A reader (:class:`EpisodeSource`) lists its episodes without decoding pictures and reads one episode at a time. Pictures
stay on disk until somebody reads them, so memory does not grow with the data set.

Axes: N recorded frames, H×W pixels, A action dimensions, S state dimensions.
"""

import errno
import hashlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Float32, UInt8

from rsjax.errors import UserError
from rsjax.files import placeholder, regular

_WHOLE = 2**18  # bytes up to which fingerprints read a file fully
_EDGE = 2**13  # bytes that they read at both ends of a larger one
MAX_PIXELS = 2**26  # of one picture: more is a damaged header, not a camera
MAX_FPS = 10_000.0  # more is a mistake, not a camera
FETCH_AGAIN = "fetch the file again or leave the episode out"
LEAVE_OUT = "leave the episode out"


class SourceError(UserError):
    """A data set cannot be read at all. The message names the file, the field and the cure."""


class EpisodeError(UserError):
    """An episode cannot be read, so it is quarantined. The message names the file, the field and the cure.

    Attributes:
        kind: one of :data:`rsjax.tools.ingest.doctor.KINDS`.
        option: the command's option that rules the episode out, such as ``--camera``; "" if none does.
    """

    def __init__(self, message: str, kind: str = "unreadable", option: str = "") -> None:
        super().__init__(message)
        self.kind = kind
        self.option = option

    @classmethod
    def at(cls, where: Path | str, problem: str, cure: str = FETCH_AGAIN, kind: str = "unreadable") -> "EpisodeError":
        """Builds the error from its parts.

        Args:
            where: the file, or the file and the place in it.
            problem: what is wrong there.
            cure: what the user can do.
        """
        return cls(f"{where}: {problem}; {cure}", kind)


def reason(error: Exception) -> str:
    """Returns why a file could not be read, on one line."""
    if isinstance(error, FileNotFoundError):
        return "missing"
    if isinstance(error, OSError) and error.strerror:
        return f"cannot be read ({error.strerror})"
    return f"cannot be read ({' '.join(str(error).split())[:200] or type(error).__name__})"


@dataclass(frozen=True)
class Segment:
    """A part of an episode that the data set itself names.

    Attributes:
        start: its first frame.
        end: the frame after its last, > start.
        text: what the robot does in it.
        skill: the data set's word for it, "" if there is none.
    """

    start: int
    end: int
    text: str
    skill: str = ""


def runs(texts: Sequence[str]) -> list[Segment]:
    """Returns a segment for each run of frames with the same text."""
    starts = [row for row, text in enumerate(texts) if row == 0 or text != texts[row - 1]]
    return [Segment(start, end, texts[start]) for start, end in itertools.pairwise([*starts, len(texts)])]


class Frames(Protocol):
    """The pictures of one camera, decoded when they are read. Can be sent to other processes."""

    def __len__(self) -> int: ...

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        """Returns these pictures, 0–255, RGB, upright; any order, repeats allowed.

        Raises:
            EpisodeError: one of them cannot be read.
        """
        ...


class Depths(Protocol):
    """The depth maps of one camera, decoded when they are read. Can be sent to other processes."""

    def __len__(self) -> int: ...

    def read(self, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
        """Returns these maps, in metres along the optical axis; 0 where the camera measured nothing.

        Raises:
            EpisodeError: one of them cannot be read.
        """
        ...


@dataclass(frozen=True)
class EpisodeRef:
    """The place of an episode. It can be pickled and written as JSON, as it travels to worker processes.

    Attributes:
        id: unique within the source, safe as a file name (see :func:`rsjax.files.safe_id`).
        fingerprint: 16 hex digits, a hash of what the episode would be read from.
        location: what the source's ``read`` needs, or ``error``: why the episode cannot be read. Also ``split``: the
            split of a store in which the episode stays; and ``recording``: the same text in all episodes that show one
            recording, which go to one split.
    """

    id: str
    fingerprint: str
    location: dict[str, Any]


@dataclass(frozen=True)
class Episode:
    """One episode; every array has a row for each frame.

    Attributes:
        id: unique within the source, safe as a file name.
        fingerprint: 16 hex digits, a hash of what it was read from.
        task: what the robot has to do; "" if the data set does not say.
        fps: frames per second, > 0.
        timestamps: seconds from the first frame, increasing.
        actions: row t led from frame t-1 into frame t, in the data set's own units; row 0 led into frame 0, or is zeros
            if the data set does not have it.
        states: what the robot measured of itself at each frame; None if it was not recorded.
        cameras: pictures by the camera's name.
        depth: depth maps by the same names; empty if none were recorded.
        segments: the data set's own segments, in order.
        meta: JSON-ready; ``meta["actions"]`` is the :class:`rsjax.tools.ingest.actions.ActionLayout` of the actions.
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
        """Lists every episode in a fixed order, without reading pictures.

        Raises:
            SourceError: the data set cannot be listed.
        """
        ...

    def read(self, ref: EpisodeRef) -> Episode:
        """Reads one episode.

        Raises:
            EpisodeError: it cannot be read, or its parts do not fit together.
        """
        ...


def checked(episode: Episode, where: Path | str) -> Episode:
    """Returns the same episode if it satisfies what :class:`Episode` promises.

    Args:
        where: the file that error messages name.

    Raises:
        EpisodeError: there are no frames, numbers of rows or pictures differ from the number of timestamps, values are
            not finite, or time does not increase.
    """
    count = len(episode.timestamps)
    if count == 0:
        raise EpisodeError.at(where, f"episode {episode.id} has no frames", "leave it out", "length")
    if not episode.cameras:
        cure = "leave it out or add its pictures"
        raise EpisodeError.at(where, f"episode {episode.id} has no camera", cure, "camera")
    arrays = {"actions": episode.actions} | ({} if episode.states is None else {"states": episode.states})
    lengths = {name: len(array) for name, array in arrays.items()}
    lengths |= {f"camera {name}": len(frames) for name, frames in episode.cameras.items()}
    lengths |= {f"depth {name}": len(maps) for name, maps in episode.depth.items()}
    for name, length in lengths.items():
        if length != count:
            problem = f"{name} has {length} rows, timestamps {count}"
            raise EpisodeError.at(where, problem, "mend or leave it out", "length")
    for name, array in ({"timestamps": episode.timestamps} | arrays).items():
        if not np.isfinite(array).all():
            row = int(np.flatnonzero(~np.isfinite(array.reshape(count, -1)).all(1))[0])
            cure = "mend the value or leave the episode out"
            raise EpisodeError.at(where, f"{name} of frame {row} is not finite", cure, "not-finite")
    if (back := np.flatnonzero(np.diff(episode.timestamps) <= 0)).size:
        problem = f"timestamps do not increase at frame {back[0] + 1}"
        raise EpisodeError.at(where, problem, "mend them or leave it out", "time")
    if not np.isfinite(episode.fps) or episode.fps <= 0:
        raise EpisodeError.at(where, f"fps is {episode.fps}", "it must be positive", "time")
    return episode


def data_file(path: Path) -> Path:
    """Returns the same path; refuses what :func:`regular` refuses, and files that hold something else than data.

    Raises:
        OSError: it cannot be read, or is a pipe, a device, a Git-LFS pointer or a web page.
    """
    if instead := placeholder(regular(path)):
        raise OSError(errno.EINVAL, instead, str(path))
    return path


def fingerprint(paths: Sequence[Path], *values: object) -> str:
    """Returns a hash of files and values, 16 hex digits.

    A missing file counts too; folder names do not, so a data set may be moved. Of files above 256 KiB only size, date
    and both ends count: reading all videos of a data set would take too long.
    """
    digest = hashlib.sha256(repr(values).encode())
    for path in paths:
        try:
            status = path.stat()
            digest.update(_file_digest(path, status.st_size, status.st_mtime_ns))
        except OSError:
            digest.update(_file_digest(path, -1, 0))
    return digest.hexdigest()[:16]


@lru_cache(maxsize=1024)  # one file may contain hundreds of episodes
def _file_digest(path: Path, size: int, modified: int) -> bytes:
    large = size > _WHOLE
    name = f"{path.name} {size} {modified if large else ''}"
    digest = hashlib.sha256(name.encode("utf-8", "surrogatepass"))  # names of files need not be UTF-8
    try:
        with regular(path).open("rb") as file:
            digest.update(file.read(_EDGE if large else _WHOLE))
            if large:
                file.seek(size - _EDGE)
                digest.update(file.read(_EDGE))
    except OSError as error:
        digest.update(str(error.errno).encode())
    return digest.digest()
