"""Reads pictures of video files by number or by time, through PyAV (H.264, AV1 and whatever else FFmpeg decodes).

A file is scanned once for the times of its frames, without decoding. Reading seeks to the key frame before the picture
and decodes on from there, or just decodes on if that is nearer. Each process keeps a few files open and closes the
least recently used one first.
"""

import contextlib
import os
import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8

from rsjax.ingest.episode import MAX_PIXELS, EpisodeError, data_file
from rsjax.ingest.pictures import stack_pictures

OPEN_FILES = 8  # decoders that one process keeps; each has a few decoded pictures in memory
# A playlist that calls itself .mp4 would otherwise make FFmpeg open the files that it names.
_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"


@dataclass(frozen=True)
class VideoIndex:
    """The frames of a video, from a scan of its packets.

    Attributes:
        stamps: each frame's presentation time in units of ``time_base``, increasing.
        keys: whether decoding can begin at the frame.
        time_base: seconds.
    """

    stamps: Int64[np.ndarray, " N"]
    keys: Bool[np.ndarray, " N"]
    time_base: Fraction

    def times(self) -> Float[np.ndarray, " N"]:
        """Returns the seconds of each frame on the file's own clock."""
        return self.stamps * float(self.time_base)


class VideoFrames:
    """A video, or some of its frames, as :class:`rsjax.ingest.episode.Frames`.

    Args:
        path: the file.
        numbers: the frames of the file that count, in order; None: all.
    """

    def __init__(self, path: Path, numbers: Int64[np.ndarray, " n"] | None = None) -> None:
        self.path, self._numbers = Path(path), numbers

    def __len__(self) -> int:
        return len(scan(self.path).stamps) if self._numbers is None else len(self._numbers)

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        """Returns these pictures, 0–255, RGB, turned as the file's display matrix says.

        Raises:
            EpisodeError: the file is damaged at one of them.
        """
        chosen = np.asarray(indices, np.int64).reshape(-1)
        if chosen.size and (chosen.min() < 0 or chosen.max() >= len(self)):
            raise IndexError(f"{self.path}: frames {chosen.min()} … {chosen.max()} of {len(self)}")
        wanted, order = np.unique(chosen if self._numbers is None else self._numbers[chosen], return_inverse=True)
        with _opened(self.path) as decoder:
            return stack_pictures((f"{self.path}: frame {number}", decoder.picture(int(number))) for number in wanted)[
                order
            ]


def at_times(path: Path, seconds: Float[np.ndarray, " n"], tolerance: float) -> VideoFrames:
    """Returns the frames of a video that are shown at these times on the file's own clock.

    Args:
        seconds: the times, increasing.
        tolerance: seconds that a frame may be away.

    Raises:
        EpisodeError: no frame is that near, or one frame is nearest to two of the times.
    """
    times = scan(path).times()
    after = np.clip(np.searchsorted(times, seconds), min(1, len(times) - 1), len(times) - 1)
    before = np.maximum(after - 1, 0)
    numbers = np.where(np.abs(times[before] - seconds) <= np.abs(times[after] - seconds), before, after)
    away = np.abs(times[numbers] - seconds)
    if (far := np.flatnonzero(~(away <= tolerance))).size:
        first = far[0]
        raise EpisodeError.at(
            path,
            f"no frame at {seconds[first]:.4f} s, row {first} of the table: the nearest is {away[first]:.2g} s away, "
            f"{tolerance:.2g} s are allowed",
            kind="time",
        )
    if (twice := np.flatnonzero(np.diff(numbers) <= 0)).size:
        raise EpisodeError.at(path, f"rows {twice[0]} and {twice[0] + 1} of the table show the same frame", kind="time")
    return VideoFrames(path, numbers.astype(np.int64))


def scan(path: Path) -> VideoIndex:
    """Returns the index of a video file, which is kept while the file stays the same.

    Raises:
        EpisodeError: the file is missing, no video, truncated, or has pictures of an impossible size.
    """
    try:
        status = path.stat()
    except OSError as error:
        raise _unreadable(path, error) from error
    return _scan(path, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=4 * OPEN_FILES)
def _scan(path: Path, size: int, modified: int) -> VideoIndex:
    """Scans a file; size and date are there so that a changed file is scanned again."""
    with _container(path) as container:
        stream = container.streams.video[0]
        height, width = stream.codec_context.height, stream.codec_context.width
        if not 0 < height * width <= MAX_PIXELS:
            raise EpisodeError.at(path, f"its header says pictures of {width} × {height}", kind="undecodable")
        promised, time_base = stream.frames, stream.time_base
        packets = _packets(path, container)
    if not packets or time_base is None:
        raise EpisodeError.at(path, "has no pictures", kind="undecodable")
    if len(packets) < promised:
        with _container(path, ignore_editlist="1") as container:  # an edit list may hide frames that are there
            present = len(_packets(path, container))
        if present < promised:
            problem = f"truncated: {present} of the {promised} frames that its header names"
            raise EpisodeError.at(path, problem, kind="undecodable")
    if any(stamp is None for stamp, _ in packets):
        raise EpisodeError.at(path, "has frames without a time, so they cannot be found", "rewrite it as MP4")
    packets.sort()
    stamps = np.array([stamp for stamp, _ in packets], np.int64)
    if (np.diff(stamps) <= 0).any():
        raise EpisodeError.at(path, "two frames have the same time", "rewrite the file with increasing times")
    return VideoIndex(stamps, np.array([key for _, key in packets]), time_base)


def _packets(path: Path, container: Any) -> list[tuple[int | None, bool]]:
    """Returns the time of each packet that becomes a visible picture, and whether decoding can begin there."""
    try:
        packets = container.demux(container.streams.video[0])
        return [(packet.pts, packet.is_keyframe) for packet in packets if packet.size and not packet.is_discard]
    except av.FFmpegError as error:
        raise _unreadable(path, error) from error


def _container(path: Path, **options: str) -> Any:
    """Opens a file; one that is named like a protocol of FFmpeg's is still only that file."""
    try:
        with data_file(path).open("rb"):
            container = av.open(
                f"file:{path}",
                metadata_errors="replace",
                options={"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"} | options,
            )
    except (OSError, av.FFmpegError) as error:
        raise _unreadable(path, error) from error
    if not container.streams.video or container.streams.video[0].codec_context is None:
        container.close()
        raise EpisodeError.at(path, "has no video stream that can be decoded", kind="undecodable")
    return container


def _unreadable(path: Path, error: Exception) -> EpisodeError:
    missing = isinstance(error, FileNotFoundError)
    problem = "missing" if missing else f"not a readable video ({getattr(error, 'strerror', None) or error})"
    return EpisodeError.at(path, problem, kind="undecodable")


_decoders: "OrderedDict[str, _Decoder]" = OrderedDict()
_lock = threading.RLock()
_inherited: list[object] = []


def _set_aside() -> None:
    """Lets a forked process open files of its own: reading the parent's would move the parent's place in them.

    This also runs between the fork and the exec of a command that is started with a ``preexec_fn``, as Ray's are. So it
    frees nothing: FFmpeg waits for its threads when it is freed, and a fork does not copy them.
    """
    global _decoders, _lock
    _inherited.append(_decoders)
    _decoders, _lock = OrderedDict(), threading.RLock()  # another thread of the parent may have had the lock


os.register_at_fork(after_in_child=_set_aside)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator["_Decoder"]:
    """Lends the file's decoder to this thread alone; one that failed is not kept."""
    index = scan(path)
    with _lock:
        decoder = _decoders.pop(str(path), None)
    if decoder is not None and decoder.index is not index:  # the file has changed
        decoder.close()
        decoder = None
    decoder = decoder or _Decoder(path, index)
    try:
        yield decoder
    except BaseException:
        decoder.close()
        raise
    with _lock:
        if (other := _decoders.pop(str(path), None)) is not None:
            other.close()
        _decoders[str(path)] = decoder
        while len(_decoders) > OPEN_FILES:
            _decoders.popitem(last=False)[1].close()


class _Decoder:
    """One open file and the position of decoding in it."""

    def __init__(self, path: Path, index: VideoIndex) -> None:
        self.path, self.index = path, index
        self._container = _container(path)
        self._stream = self._container.streams.video[0]
        self._stream.codec_context.thread_count = 1  # many processes decode at once, one a core
        self._stream.codec_context.options = {
            "err_detect": "explode",  # H.264 would paint over damage and say nothing
            "max_pixels": str(MAX_PIXELS),  # pictures may be of another size than the header says
        }
        self._starts = np.flatnonzero(index.keys)
        self._frames: Iterator[Any] = iter(())
        self._next = len(index.stamps)  # number of the frame that comes next; at the end, so the first read seeks

    def close(self) -> None:
        self._frames = iter(())
        self._container.close()

    def picture(self, number: int) -> UInt8[np.ndarray, "H W 3"]:
        """Decodes one frame of the file."""
        frame = self._decode(number)
        picture = frame.to_ndarray(format="rgb24", threads=1)  # threads would hang a forked process that frees them
        return np.rot90(picture, round(frame.rotation / 90)) if frame.rotation else picture

    def _decode(self, number: int) -> Any:
        """Decodes a frame: on from here if that is nearest, from the key frame before it, or from farther back.

        In an open group of pictures the first frames depend on the group before, so one key frame may not be enough.
        """
        near = self._start(number)
        attempts: list[int | None] = [near, self._start(max(0, near - 1)), 0]
        reason: object = "the decoder leaves it out"
        for start in dict.fromkeys([None, *attempts] if near <= self._next <= number else attempts):
            try:
                if start is not None:
                    self._container.seek(int(self.index.stamps[start]), stream=self._stream, backward=True)
                    self._frames = self._container.decode(self._stream)
                if (frame := self._decode_until(number)) is not None:
                    return frame
            except (av.FFmpegError, OSError) as error:
                reason = error
        seconds = float(self.index.stamps[number] * self.index.time_base)
        raise EpisodeError.at(self.path, f"frame {number} (at {seconds:.3f} s) cannot be decoded: {reason}")

    def _start(self, number: int) -> int:
        """Returns the nearest frame at or before this one at which decoding can begin."""
        place = int(np.searchsorted(self._starts, number, side="right")) - 1
        return int(self._starts[place]) if place >= 0 else 0

    def _decode_until(self, number: int) -> Any:
        """Decodes on up to this frame; None if the decoder passes it by."""
        stamps = self.index.stamps
        for frame in self._frames:
            if frame.pts is None or frame.pts > stamps[-1]:
                continue
            place = int(np.searchsorted(stamps, frame.pts))
            self._next = place + 1
            if place >= number:
                return frame if stamps[number] == frame.pts and not frame.is_corrupt else None
        return None
