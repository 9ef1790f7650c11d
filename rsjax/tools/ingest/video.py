"""Reads pictures of video files by number or by time with PyAV (H.264, AV1 and any other codec of FFmpeg).

Reading seeks to the key frame before the picture (:class:`VideoIndex` lists the key frames) and decodes from there, or
continues from the current position if that is nearer. Each process keeps a few files open and closes the least recently
used one first.

The index comes from the packets alone, without decoding, unless the file may lack correct presentation times: AVI has
none, and a file that was copied from an AVI file may have invented ones. Such a file is decoded once, in order.
"""

import contextlib
import itertools
import os
import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8

from rsjax.tools.ingest.episode import MAX_PIXELS, EpisodeError, data_file
from rsjax.tools.ingest.pictures import stack_pictures

OPEN_FILES = 8  # decoders that one process keeps; each holds a few decoded pictures in memory
_TRIAL = 64  # frames that are decoded to test whether they come out in the order of their times
# A playlist that calls itself .mp4 would otherwise make FFmpeg open the files that it names.
_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"
_COMPARED = 64  # seeking is checked among this many first frames of a file


@dataclass(frozen=True)
class VideoIndex:
    """The frames of a video, in the order in which they are shown.

    Attributes:
        stamps: each frame's presentation time in units of ``time_base``, increasing.
        labels: the stamp by which each frame is found in the file; equal to ``stamps`` unless the order differs.
        keys: whether decoding can begin at the frame.
        time_base: length of a unit in seconds.
    """

    stamps: Int64[np.ndarray, " N"]
    labels: Int64[np.ndarray, " N"]
    keys: Bool[np.ndarray, " N"]
    time_base: Fraction

    def times(self) -> Float[np.ndarray, " N"]:
        """Returns the seconds of each frame on the file's own clock."""
        return self.stamps * float(self.time_base)


def scan(path: Path) -> VideoIndex:
    """Returns the index of a video file, from a cache as long as the file stays the same.

    Raises:
        EpisodeError: the file is missing, not a video or truncated, has pictures of an impossible size, or has missing
            or repeated times.
    """
    try:
        status = path.stat()
    except OSError as error:
        raise _unreadable(path, error) from error
    return _scan(path, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=4 * OPEN_FILES)
def _scan(path: Path, size: int, modified: int) -> VideoIndex:
    """Scans a file; ``size`` and ``modified`` make the cache scan a changed file again."""
    with open_container(path) as container:
        stream = container.streams.video[0]
        height = stream.codec_context.height
        width = stream.codec_context.width
        if not 0 < height * width <= MAX_PIXELS:
            raise EpisodeError.at(path, f"its header says pictures of {width} × {height}", kind="undecodable")
        promised = stream.frames
        time_base = stream.time_base
        avi = _is_avi(container)
        reorders = stream.codec_context.codec.reorder and (avi or stream.codec_context.has_b_frames)
        packets = _packets(path, container)
    if not packets or time_base is None:
        raise EpisodeError.at(path, "has no pictures", kind="undecodable")
    keys = {stamp: key for stamp, key in packets if stamp is not None}
    if None in dict(packets):
        raise EpisodeError.at(path, "has frames without a time, so they cannot be found", "rewrite it as MP4")
    present = len(packets)
    if avi:
        present = max(keys) + 1  # the header also counts empty packets, which repeat the previous picture
    elif present < promised:
        with open_container(path, ignore_editlist="1") as container:  # an edit list may hide frames that are there
            present = len(_packets(path, container))
    if present < promised:
        problem = f"truncated: {present} of the {promised} frames that its header names"
        raise EpisodeError.at(path, problem, kind="undecodable")
    stamps = sorted(keys)
    if len(keys) < len(packets):
        raise EpisodeError.at(path, "two frames have the same time", "rewrite the file with increasing times")
    in_order = list(keys) == stamps  # either frames are stored as shown, or the stamps are wrong
    if reorders and in_order:
        labels = _shown_order(path, stamps, avi)
    else:
        labels = stamps
    return VideoIndex(np.array(stamps), np.array(labels), np.array([keys[label] for label in labels]), time_base)


def decoded(container: Any) -> Iterator[Any]:
    """Yields the frames of a file from its current position on, in the order in which they are shown.

    The ``pts`` of each is its label in the file's :class:`VideoIndex`.
    """
    for packet in _demuxed(container):
        yield from packet.decode()


def open_decoder(path: Path) -> Any:
    """Opens a file for decoding in one thread (each core has its own process), with damage as an error."""
    container = open_container(path)
    context = container.streams.video[0].codec_context
    context.thread_count = 1
    context.options = {
        "err_detect": "explode",  # otherwise H.264 conceals damage silently
        "max_pixels": str(MAX_PIXELS),  # pictures may be larger than the header says
    }
    return container


def open_container(path: Path, **options: str) -> Any:
    """Opens a file, even if its name looks like one of FFmpeg's protocols."""
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


def _is_avi(container: Any) -> bool:
    return container.format.name == "avi"


def _demuxed(container: Any) -> Iterator[Any]:
    """Yields the packets of the pictures. In AVI their label is their place in the file: FFmpeg guesses their times."""
    avi = _is_avi(container)
    for packet in container.demux(container.streams.video[0]):
        if avi and packet.dts is not None:
            if not packet.size:
                continue  # repeats the previous picture; FFmpeg would take it for the end
            packet.pts = packet.dts
        yield packet


def _packets(path: Path, container: Any) -> list[tuple[int | None, bool]]:
    """Returns the stamp of each packet that becomes a visible picture, and whether decoding can begin there."""
    try:
        packets = _demuxed(container)
        return [(packet.pts, packet.is_keyframe) for packet in packets if packet.size and not packet.is_discard]
    except av.FFmpegError as error:
        raise _unreadable(path, error) from error


def _shown_order(path: Path, labels: list[int], avi: bool) -> list[int]:
    """Returns the labels of all frames in the order in which they are shown, found by decoding.

    Args:
        labels: labels in the order of the file.
        avi: whether the file's order means nothing; otherwise it is trusted if the first frames come out in it.

    Raises:
        EpisodeError: the order cannot be found, because not all frames can be decoded.
    """
    if not avi and (shown := _decoded_labels(path, labels[:_TRIAL])) == sorted(shown):
        return labels
    shown = _decoded_labels(path, labels)
    if sorted(shown) != labels:
        problem = (
            f"does not say when its frames are shown, and in order only {len(shown)} of {len(labels)} can be decoded"
        )
        raise EpisodeError.at(path, problem, kind="undecodable")
    return shown


def _decoded_labels(path: Path, labels: list[int]) -> list[int]:
    """Decodes a file and returns the labels in the order in which their frames come out, up to the first damage."""
    shown: list[int] = []
    known = set(labels)
    with open_decoder(path) as container, contextlib.suppress(av.FFmpegError):
        shown.extend(islice((frame.pts for frame in decoded(container) if frame.pts in known), len(labels)))
    return shown


def _unreadable(path: Path, error: Exception) -> EpisodeError:
    missing = isinstance(error, FileNotFoundError)
    if missing:
        problem = "missing"
    else:
        problem = f"not a readable video ({getattr(error, 'strerror', None) or error})"
    return EpisodeError.at(path, problem, kind="undecodable")


class VideoFrames:
    """A video, or some of its frames, as :class:`rsjax.tools.ingest.episode.Frames`.

    Args:
        path: the file.
        numbers: the file's frames that belong to the video, in order; None: all.
    """

    def __init__(self, path: Path, numbers: Int64[np.ndarray, " n"] | None = None) -> None:
        self.path = Path(path)
        self._numbers = numbers

    def __len__(self) -> int:
        if self._numbers is None:
            return len(scan(self.path).stamps)
        return len(self._numbers)

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        """Returns these pictures, 0–255, RGB, rotated as the file's display matrix says.

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


def misread(path: Path, count: int = 5) -> int | None:
    """Returns the first checked frame whose picture differs between decoding in order and seeking; None if none does.

    Args:
        count: frames to check, spread over the first few dozen of the file.

    Raises:
        EpisodeError: the file cannot be read.
    """
    index = scan(path)
    last = min(len(index.labels), _COMPARED) - 1
    chosen = np.unique(np.linspace(0, last, count).astype(int)).tolist()
    known = set(index.labels.tolist())
    sought = dict[int, UInt8[np.ndarray, "H W 3"]]()
    with contextlib.closing(_Decoder(path, index)) as decoder:
        for number in reversed(chosen):  # in this order each read seeks
            with contextlib.suppress(EpisodeError):
                sought[number] = decoder.picture(number)
    with open_decoder(path) as container, contextlib.suppress(av.FFmpegError):  # reading frames reports damage
        frames = (frame for frame in decoded(container) if frame.pts in known)
        for number, frame in enumerate(itertools.islice(frames, last + 1)):
            if number in chosen and not (number in sought and np.array_equal(sought[number], _upright(frame))):
                return number
    return None


def at_times(path: Path, seconds: Float[np.ndarray, " n"], tolerance: float) -> VideoFrames:
    """Returns the frames of a video that are shown at these times on the file's own clock.

    Args:
        seconds: the times, increasing.
        tolerance: largest distance of a frame from its time, in seconds.

    Raises:
        EpisodeError: a time has no frame that near, or one frame is nearest to two of the times.
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


_decoders: "OrderedDict[str, _Decoder]" = OrderedDict()
_lock = threading.RLock()
_inherited: list[object] = []


def _set_aside() -> None:
    """Makes a forked process open its own files: reading the parent's would move the parent's position in them.

    This also runs between the fork and the exec of a command that is started with a ``preexec_fn``, as Ray's commands
    are. So it frees nothing: freeing a decoder waits for FFmpeg's threads, and a fork does not copy threads.
    """
    global _decoders, _lock
    _inherited.append(_decoders)
    _decoders = OrderedDict()
    _lock = threading.RLock()  # another thread of the parent may have held the old one


os.register_at_fork(after_in_child=_set_aside)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator["_Decoder"]:
    """Lends the file's decoder to this thread alone; a decoder that failed is not kept."""
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
    """An open file and the current decoding position in it."""

    def __init__(self, path: Path, index: VideoIndex) -> None:
        self.path = path
        self.index = index
        self._container = open_decoder(path)
        self._stream = self._container.streams.video[0]
        self._starts = np.flatnonzero(index.keys)
        self._numbers = {label: number for number, label in enumerate(index.labels.tolist())}
        self._frames: Iterator[Any] = iter(())
        self._next = len(index.labels)  # number of the frame that comes next; at the end, so the first read seeks

    def close(self) -> None:
        self._frames = iter(())
        self._container.close()

    def picture(self, number: int) -> UInt8[np.ndarray, "H W 3"]:
        """Decodes one frame of the file, from the current position if that is nearest, else from an earlier key frame.

        In an open group of pictures the first frames depend on the previous group. So if the nearest key frame is not
        enough, decoding starts at the one before it, and then at the first frame.
        """
        near = self._start(number)
        attempts: list[int | None] = [near, self._start(max(0, near - 1)), 0]
        reason: object = "the decoder leaves it out"
        for start in dict.fromkeys([None, *attempts] if near <= self._next <= number else attempts):
            try:
                if start is not None:
                    self._container.seek(int(self.index.labels[start]), stream=self._stream, backward=True)
                    self._frames = decoded(self._container)
                frame = self._decode_until(number)
            except (av.FFmpegError, OSError) as error:
                reason = error
                continue
            if frame is not None:
                return _upright(frame)
        seconds = float(self.index.stamps[number] * self.index.time_base)
        raise EpisodeError.at(self.path, f"frame {number} (at {seconds:.3f} s) cannot be decoded: {reason}")

    def _start(self, number: int) -> int:
        """Returns the nearest frame at or before this one at which decoding can begin."""
        place = int(np.searchsorted(self._starts, number, side="right")) - 1
        if place >= 0:
            return int(self._starts[place])
        return 0

    def _decode_until(self, number: int) -> Any:
        """Continues decoding up to this frame; returns None if the decoder skips it."""
        for frame in self._frames:
            if (place := self._numbers.get(frame.pts)) is None:
                continue
            self._next = place + 1
            if place >= number:
                if place == number and not frame.is_corrupt:
                    return frame
                return None
        return None


def _upright(frame: Any) -> UInt8[np.ndarray, "H W 3"]:
    """Returns a decoded frame as RGB, rotated as the file's display matrix says."""
    picture = frame.to_ndarray(format="rgb24", threads=1)  # threads would hang a forked process that frees them
    if frame.rotation:
        return np.rot90(picture, round(frame.rotation / 90))
    return picture
