"""Windows: fixed numbers of frames at a fixed rate, as an index into an episode, and which of them become clips.

Windows overlap: a minute at 30 fps has about a hundred windows of 16 frames at 2 Hz, each spanning 226 recorded frames.
So depth and tracks are made once per episode, and a window is only the list of its frame numbers. Frames are chosen by
their time stamps, because not every camera keeps its rate.

Axes: N recorded frames, T frames of a window, W windows, S spans.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from rsjax.config import require
from rsjax.tools.ingest.episode import EpisodeError, Segment

MAX_STEP = 2**20  # recorded frames from one frame of a window to the next
DRIFT = 0.25  # recorded frames by which a window may end too late where the rate is lower than windows take
_TIE = 1e-6  # share of a frame interval: two frames count as equally near up to this rounding error
Span = tuple[int, int]  # first frame, and the one after the last


@dataclass(frozen=True)
class WindowConfig:
    """The settings by which episodes are cut and windows are kept.

    Motion is ``rsjax.tools.ingest.annotators.protocols.Motion.high``, in pixels per second of a 256-pixel-wide picture.
    """

    frames: int = 16  # of a window, which becomes a clip
    rate: float = 2.0  # frames per second of a window, by the time stamps; 0: each recorded frame
    hop: int = 1  # distance between the starts of successive windows, in frames of the window
    within_segments: bool = False  # each window in one segment of the data set; else only cuts between shots bound it
    least_motion: float = 0.0  # mean over the window's frames; below it, nothing happens
    most_motion: float = float("inf")  # above it, the camera shakes or the picture is broken
    key_frame: bool = False  # keep only windows with a key frame
    most_gap: float = 1.5  # longest time between two frames of a window, relative to 1 / rate; a recording may stop

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
        frames: the recorded frames of each window, increasing, unless the recording stopped between them.
        short: how many spans (shots, segments) are too short for a window.
    """

    frames: Int[np.ndarray, "W T"]
    short: int = 0

    def __len__(self) -> int:
        return len(self.frames)


def check_rate(fps: float, config: WindowConfig) -> float:
    """Returns the distance between two frames of a window in recorded frames, 1 or more.

    Raises:
        EpisodeError: the recording has a lower rate than windows need, or a rate that no camera has.
    """
    if config.rate:
        step = fps / config.rate
    else:
        step = 1.0
    if not step < MAX_STEP:
        raise EpisodeError(f"fps: recorded at {fps:g} fps, which no camera does; mend the file's rate or times")
    # A clock that jitters gives a rate a little off; over a window the frames stay those nearest to its steps.
    if step < 1 - DRIFT / config.frames:
        message = f"fps: recorded at {fps:g} fps, windows take {config.rate:g}; lower windows.rate"
        raise EpisodeError(message, option="--windows.rate")
    return step


def index_windows(
    timestamps: Float[np.ndarray, " N"], fps: float, spans: Sequence[Span], config: WindowConfig
) -> WindowIndex:
    """Returns all windows that lie within one span: the recorded frames nearest to even steps of ``1 / rate`` seconds.

    Args:
        timestamps: seconds of the recorded frames, increasing.
        fps: recorded frames per second.
        spans: the spans of the episode, in order, without overlap.
        config: how long windows are and how far apart they start.

    Raises:
        EpisodeError: as :func:`check_rate`.
    """
    check_rate(fps, config)
    parts = [np.zeros((0, config.frames), np.int64)]
    short = 0
    for first, end in spans:
        clock = timestamps[first:end]
        count = len(clock)
        rate = config.rate
        if not rate:  # as recorded
            rate = 1.0
            clock = np.arange(count, dtype=np.float64)
        clock = np.append(clock, clock[-1] + (1 / fps if config.rate else 1))  # a step nearest to this end is too late
        # Only even steps nearest to some frame start a window: a recording that stops for years has few of them.
        numbers = np.unique(np.floor((clock - clock[0]) * rate / config.hop + 0.5 + _TIE))
        starts = np.unique(_nearest(clock, clock[0] + numbers * config.hop / rate))
        frames = _nearest(clock, clock[starts, None] + np.arange(config.frames) / rate)
        windows = first + frames[frames[:, -1] < count]
        short += not len(windows)
        parts.append(windows)
    return WindowIndex(np.concatenate(parts), short)


def _nearest(times: Float[np.ndarray, " n"], wanted: Float[np.ndarray, "*m"]) -> Int[np.ndarray, "*m"]:
    """Returns the index of the nearest of increasing times, the later one if two are; there must be at least two."""
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    share = (wanted - times[after - 1]) / (times[after] - times[after - 1])
    return after - (share < 0.5 - _TIE)


def cut_spans(count: int, shots: Sequence[Span], segments: Sequence[Segment], config: WindowConfig) -> list[Span]:
    """Returns the spans that bound windows: the shots, or their parts within one segment if ``config`` asks for it.

    Args:
        count: number of recorded frames; shots are cut off there.
        shots: in order, without overlap; none: the episode is one shot.
        segments: the data set's own segments.

    Raises:
        EpisodeError: windows have to lie within segments, but segments overlap.
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
    """Returns the segment with most of a window's frames, the earlier one of two; None if no segment has any."""
    shares = [int(((frames >= segment.start) & (frames < segment.end)).sum()) for segment in segments]
    if any(shares):
        return segments[int(np.argmax(shares))]
    return None


def judge(
    index: WindowIndex,
    timestamps: Float[np.ndarray, " N"],
    motion: Float[np.ndarray, " N"] | None,
    key_frames: Sequence[int],
    config: WindowConfig,
) -> list[str]:
    """Returns the reason why each window is left out; "" if it is kept.

    Args:
        index: the windows.
        timestamps: seconds of the recorded frames.
        motion: motion of each frame against the previous one, in pixels per second of a 256-pixel-wide picture; None if
            it was not measured, then no window is left out for it.
        key_frames: recorded frames at which something decisive happens.

    Returns:
        ``gap``, ``still``, ``shaking``, ``no key frame`` or "".
    """
    frames = index.frames
    if len(timestamps) > 1:
        recorded = float(np.median(np.diff(timestamps)))
    else:
        recorded = 0.0
    numbers = np.diff(frames, axis=1)
    seconds = np.diff(timestamps[frames], axis=1)
    # Rounding to recorded frames makes some steps longer than 1 / rate although no frame is missing.
    steps = np.maximum(numbers * recorded, 1 / config.rate if config.rate else 0.0)
    torn = ((seconds > config.most_gap * steps) | (numbers < 1)).any(1)
    means = np.full(len(index), np.nan)  # nan passes both bounds
    if motion is not None:
        # The first frame's own motion lies before the window.
        sums = np.concatenate([[0.0], np.cumsum(motion, dtype=np.float64)])
        first = frames[:, 0]
        last = frames[:, -1]
        means = (sums[last + 1] - sums[first + 1]) / np.maximum(last - first, 1)
    keys = np.sort(np.asarray(key_frames, np.int64))
    has_key = np.searchsorted(keys, frames[:, 0]) < np.searchsorted(keys, frames[:, -1], "right")
    reasons = {
        "gap": torn,
        "still": means < config.least_motion,
        "shaking": means > config.most_motion,
        "no key frame": ~has_key & config.key_frame,
    }
    return np.select(list(reasons.values()), list(reasons), "").tolist()


def tally(reasons: Sequence[str]) -> dict[str, int]:
    """Counts the windows by reason; ``kept`` counts those without one. The numbers add up to all windows."""
    counts = Counter(reasons)
    return {"kept": counts.pop("", 0), **dict(sorted(counts.items()))}


def starts_by_reason(index: WindowIndex, reasons: Sequence[str]) -> dict[str, list[int]]:
    """Returns the first frames of the windows that each reason leaves out."""
    starts: dict[str, list[int]] = {}
    for start, reason in zip(index.frames[:, 0].tolist(), reasons, strict=True):
        if reason:
            starts.setdefault(reason, []).append(start)
    return starts
