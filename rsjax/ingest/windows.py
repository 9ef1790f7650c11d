"""Windows: fixed numbers of frames at a fixed rate, as an index into an episode, and which of them become clips.

Windows overlap: a minute at 30 fps has about a hundred of 16 frames at 2 Hz, each spanning 226 recorded frames. So
depth and tracks are made once per episode, and a window is no more than the numbers of its frames.

Axes: N recorded frames, T frames of a window, W windows, S spans.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from rsjax.config import require
from rsjax.ingest.episode import EpisodeError, Segment

MAX_STEP = 2**20  # recorded frames from one frame of a window to the next
Span = tuple[int, int]  # first frame, and the one after the last


@dataclass(frozen=True)
class WindowConfig:
    """How episodes are cut, and which windows are kept.

    Motion is ``rsjax.ingest.annotators.protocols.Motion.high``, in pixels per second of a 256-pixel-wide picture.
    """

    frames: int = 16
    rate: float = 2.0  # frames per second of a window; 0: as recorded
    hop: int = 1  # frames of the window between one window's start and the next one's
    within_segments: bool = False  # each window in one segment of the data set; else only cuts between shots bound it
    least_motion: float = 0.0  # mean over the window's frames; below, nothing happens
    most_motion: float = float("inf")  # above, the camera shakes or the picture is broken
    key_frame: bool = False  # keep only windows with a key frame
    most_gap: float = 1.5  # of the time between two frames of a window, relative to 1 / rate; a recording may stop

    def __post_init__(self) -> None:
        require(2 <= self.frames <= 4096, f"windows.frames is {self.frames}; a clip has 2 to 4096 frames")
        require(self.rate >= 0, f"windows.rate is {self.rate}; it must be positive, or 0 for the recorded rate")
        require(self.hop >= 1, f"windows.hop is {self.hop}; it must be at least 1")
        require(
            self.least_motion <= self.most_motion,
            f"windows.least_motion {self.least_motion} is above windows.most_motion {self.most_motion}; nothing passes",
        )
        require(self.most_gap >= 1, f"windows.most_gap is {self.most_gap}; it must be at least 1")


@dataclass(frozen=True)
class WindowIndex:
    """The windows of one episode.

    Attributes:
        offsets: recorded frames from a window's first frame to each of its frames; the same for all windows.
        starts: each window's first frame, increasing.
        short: how many spans (shots, segments) are too short for a window.
    """

    offsets: Int[np.ndarray, " T"]
    starts: Int[np.ndarray, " W"]
    short: int = 0

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def span(self) -> int:
        """Recorded frames from a window's first frame to its last, both included."""
        return int(self.offsets[-1]) + 1

    def frames(self, window: int) -> Int[np.ndarray, " T"]:
        """Returns the recorded frames of a window."""
        return self.starts[window] + self.offsets


def frame_offsets(fps: float, config: WindowConfig) -> Int[np.ndarray, " T"]:
    """Returns the recorded frames nearest to even steps of ``1 / rate`` seconds, from 0 on, increasing.

    Raises:
        EpisodeError: it was recorded at a lower rate than windows take, or at one that no camera has.
    """
    step = fps / config.rate if config.rate else 1.0
    if not step < MAX_STEP:
        raise EpisodeError(f"fps: recorded at {fps:g} fps, which no camera does; mend the file's rate or times")
    if step < 1 - 1e-6:
        message = f"fps: recorded at {fps:g} fps, windows take {config.rate:g}; lower windows.rate"
        raise EpisodeError(message, option="--windows.rate")
    return np.floor(np.arange(config.frames) * step + 0.5 + 1e-9).astype(np.int64)


def index_windows(fps: float, spans: Sequence[Span], config: WindowConfig) -> WindowIndex:
    """Returns all windows that lie within one span.

    Args:
        fps: recorded frames per second.
        spans: in order, without overlap.
        config: how long windows are and how far apart.

    Raises:
        EpisodeError: as :func:`frame_offsets`.
    """
    offsets = frame_offsets(fps, config)
    step = fps / config.rate if config.rate else 1.0
    starts, short = [np.zeros(0, np.int64)], 0
    for first, end in spans:
        last = end - first - int(offsets[-1]) - 1  # the last possible start, from the first frame of the span
        if last < 0:
            short += 1
            continue
        even = np.floor(np.arange(int(last / (step * config.hop)) + 2) * step * config.hop + 0.5 + 1e-9)
        starts.append(first + even[even <= last].astype(np.int64))
    return WindowIndex(offsets, np.concatenate(starts), short)


def cut_spans(count: int, shots: Sequence[Span], segments: Sequence[Segment], config: WindowConfig) -> list[Span]:
    """Returns the spans that bound windows: the shots, or their parts in one segment where the config asks for it.

    Args:
        count: recorded frames; shots are cut off there.
        shots: in order, without overlap; none: the episode is one shot.
        segments: the data set's own.

    Raises:
        EpisodeError: segments within which windows are to lie overlap.
    """
    spans = [(max(0, first), min(end, count)) for first, end in shots or [(0, count)]]
    if config.within_segments and segments:
        ordered = sorted(segments, key=lambda segment: segment.start)
        for before, after in pairwise(ordered):
            if after.start < before.end:
                message = f"segments: {before.text!r} and {after.text!r} overlap; turn within_segments off"
                raise EpisodeError(message, option="--windows.within-segments")
        spans = [(max(a, s.start), min(b, s.end)) for a, b in spans for s in ordered]
    return [(first, end) for first, end in spans if end > first]


def segment_at(segments: Sequence[Segment], frames: Int[np.ndarray, " T"]) -> Segment | None:
    """Returns the segment with most of a window's frames, the earlier one of two; None where none has any."""
    shares = [int(((frames >= segment.start) & (frames < segment.end)).sum()) for segment in segments]
    return segments[int(np.argmax(shares))] if any(shares) else None


def judge(
    index: WindowIndex,
    timestamps: Float[np.ndarray, " N"],
    motion: Float[np.ndarray, " N"] | None,
    key_frames: Sequence[int],
    config: WindowConfig,
) -> list[str]:
    """Returns why each window is left out, "" where it is kept.

    Args:
        index: the windows.
        timestamps: seconds of the recorded frames.
        motion: of each frame against the one before, in pixels per second of a 256-pixel-wide picture; None where it
            was not measured, then no window is left out for it.
        key_frames: recorded frames at which something decisive happens.

    Returns:
        ``gap``, ``still``, ``shaking``, ``no key frame`` or "".
    """
    frames = index.starts[:, None] + index.offsets
    recorded = float(np.median(np.diff(timestamps))) if len(timestamps) > 1 else 0.0
    # Rounding to recorded frames makes some steps longer than 1 / rate where nothing is missing.
    steps = np.maximum(np.diff(index.offsets) * recorded, 1 / config.rate if config.rate else 0.0)
    torn = (np.diff(timestamps[frames], axis=1) > config.most_gap * steps).any(1) if len(index) else np.zeros(0, bool)
    means = np.full(len(index), np.nan) if motion is None else _window_means(motion, index)  # nan passes both bounds
    keys = np.sort(np.asarray(key_frames, np.int64))
    has_key = np.searchsorted(keys, index.starts) < np.searchsorted(keys, index.starts + index.span)
    reasons = {
        "gap": torn,
        "still": means < config.least_motion,
        "shaking": means > config.most_motion,
        "no key frame": ~has_key & config.key_frame,
    }
    return np.select(list(reasons.values()), list(reasons), "").tolist()


def tally(reasons: Sequence[str]) -> dict[str, int]:
    """Counts the windows by reason; ``kept`` is the rest. The numbers add up to all windows."""
    counts = Counter(reasons)
    return {"kept": counts.pop("", 0), **dict(sorted(counts.items()))}


def starts_by_reason(index: WindowIndex, reasons: Sequence[str]) -> dict[str, list[int]]:
    """Returns the first frames of the windows that each reason leaves out."""
    starts: dict[str, list[int]] = {}
    for start, reason in zip(index.starts.tolist(), reasons, strict=True):
        if reason:
            starts.setdefault(reason, []).append(start)
    return starts


def _window_means(motion: Float[np.ndarray, " N"], index: WindowIndex) -> Float[np.ndarray, " W"]:
    """Returns the mean motion between a window's first frame and its last; that of the first frame lies before it."""
    sums = np.concatenate([[0.0], np.cumsum(motion, dtype=np.float64)])
    return (sums[index.starts + index.span] - sums[index.starts + 1]) / (index.span - 1)
