"""Opens video files and lists their frames: when each is shown, and where decoding can begin.

The list comes from the packets alone, without decoding, unless the file may lack correct presentation times: AVI has
none, and a file that was copied from an AVI file may have invented ones. Such a file is decoded once, in order.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import Bool, Float, Int64

from rsjax.tools.ingest.episode import MAX_PIXELS, EpisodeError, data_file

OPEN_FILES = 8  # decoders that one process keeps; each holds a few decoded pictures in memory
_TRIAL = 64  # frames that are decoded to test whether they come out in the order of their times
# A playlist that calls itself .mp4 would otherwise make FFmpeg open the files that it names.
_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"


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
        height, width = stream.codec_context.height, stream.codec_context.width
        if not 0 < height * width <= MAX_PIXELS:
            raise EpisodeError.at(path, f"its header says pictures of {width} × {height}", kind="undecodable")
        promised, time_base = stream.frames, stream.time_base
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
    labels = _shown_order(path, stamps, avi) if reorders and in_order else stamps
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
    problem = "missing" if missing else f"not a readable video ({getattr(error, 'strerror', None) or error})"
    return EpisodeError.at(path, problem, kind="undecodable")
