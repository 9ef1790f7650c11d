"""Checks of one episode beyond those of its reader, and the statistics that compare it with the other episodes.

A reader has already checked (:func:`checked`) that every array has a row for each frame, that
values are finite and that time increases.

Axes: N recorded frames, A action and S state dimensions.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8

from rsjax.config import require
from rsjax.tools.ingest.actions import Layout
from rsjax.tools.ingest.episode import Depths, Episode, EpisodeError, Frames
from rsjax.tools.ingest.video import VideoFrames, misread

KINDS = {
    "unreadable": "the reader refuses the episode for another reason",
    "camera": "pictures are missing that other episodes have, or are blank, or never change",
    "undecodable": "a video, picture or depth map is missing or cannot be decoded",
    "seeking": "a video gives other pictures by seeking than by decoding it in order",
    "length": "actions, states or pictures are not as many as the timestamps",
    "not-finite": "values are NaN or infinite",
    "time": "time stands still, jumps, or does not match fps",
    "action": "actions are all zero, of another width, or far beyond the usual",
    "state": "states jump, or are of another width",
    "quaternion-flip": "a quaternion changes its sign from one frame to the next",
    "depth": "depth is negative, or nothing was measured",
    "segment": "a segment lies outside the episode, or is empty",
    "no-task": "the episode does not name its task",
    "duplicate": "the same content or the same id as another episode",
}
_CHUNK = 16  # pictures decoded at once
_REWRITE = "rewrite the video, such as with ffmpeg -i OLD NEW.mp4"
_TOLERANCE = 1e-3  # of a unit quaternion's length

Problem = tuple[str, str]  # one of KINDS, and what is wrong where


@dataclass(frozen=True)
class Finding:
    """A problem of an episode.

    Attributes:
        episode: its id.
        kind: one of :data:`KINDS`.
        detail: what is wrong where, in one line.
    """

    episode: str
    kind: str
    detail: str


@dataclass(frozen=True)
class Thresholds:
    """The limits of the checks.

    Attributes:
        frames: pictures of each camera that are decoded, evenly spread over the episode; 0: all.
        gap: longest time between two frames, relative to 1 / fps.
        unusual: largest action, or step of the state, relative to the median over the episodes.
    """

    frames: int = 5
    gap: float = 1.5
    unusual: float = 20.0

    def __post_init__(self) -> None:
        require(self.frames >= 0, f"frames is {self.frames}; it must be positive, or 0 for all")
        require(self.gap > 1, f"gap is {self.gap}; it is relative to 1 / fps and must be above 1")
        require(self.unusual > 1, f"unusual is {self.unusual}; it is relative to the usual and must be above 1")


@dataclass(frozen=True)
class EpisodeStats:
    """Statistics of an episode by which it is compared with the others: a few hundred bytes.

    Attributes:
        digest: hash of its actions, states and first picture; None if no picture could be decoded.
        cameras: names of its cameras.
        reach: largest absolute action of each dimension.
        jump: largest step of each dimension of the state.
    """

    digest: bytes | None
    cameras: tuple[str, ...]
    reach: Float32[np.ndarray, " A"]
    jump: Float32[np.ndarray, " S"]


def check_episode(episode: Episode, limits: Thresholds) -> tuple[list[Finding], EpisodeStats]:
    """Returns all problems found in one episode by itself, and its statistics."""
    problems = [*_time(episode, limits.gap), *_actions(episode), *_flips(episode), *_segments(episode)]
    first: UInt8[np.ndarray, "H W 3"] | None = None
    for name, frames in episode.cameras.items():
        more, picture = _pictures(name, frames, limits.frames, moving=bool(episode.actions[1:].any()))
        problems += more
        first = picture if first is None else first
    for name, maps in episode.depth.items():
        problems += _depth(name, maps, limits.frames)
    if not episode.task.strip():
        problems.append(("no-task", "its task is empty"))
    states = np.zeros((0, 0), np.float32) if episode.states is None else episode.states
    digest = None
    if first is not None:
        digest = hashlib.sha256(first.tobytes() + episode.actions.tobytes() + states.tobytes()).digest()
    reach, jump = _largest(episode.actions[1:]), _largest(np.diff(states, axis=0))
    stats = EpisodeStats(digest, tuple(episode.cameras), reach, jump)
    return [Finding(episode.id, kind, detail) for kind, detail in problems], stats


def _largest(rows: Float[np.ndarray, "N n"]) -> Float32[np.ndarray, " n"]:
    """Returns the largest absolute value of each column; 0 if there are no rows."""
    return np.abs(rows).max(0, initial=0).astype(np.float32)


def _time(episode: Episode, gap: float) -> Iterator[Problem]:
    steps = np.diff(episode.timestamps)
    if not len(steps):
        yield "length", "has 1 frame, so nothing happens in it"
    elif abs(np.median(steps) * episode.fps - 1) > 0.1:
        yield "time", f"frames are {np.median(steps):.4g} s apart (median), fps is {episode.fps:g}"
    elif (long := np.flatnonzero(steps > gap / episode.fps)).size:
        yield "time", f"{steps[long[0]]:.3g} s before frame {long[0] + 1} at {episode.fps:g} fps ({len(long)} such)"


def _actions(episode: Episode) -> Iterator[Problem]:
    rows = episode.actions[1:]
    if len(rows) and not rows.any():
        yield "action", "all are zero"
    layout = Layout.from_json(episode.meta.get("actions", {}))
    for doubt in layout.unclear:
        yield "action", f"{doubt}, so it is no step: declare kind and held"
    for first in layout.quaternions:
        lengths = np.linalg.norm(rows[:, first : first + 4], axis=1)
        if (off := np.flatnonzero(np.abs(lengths - 1) > _TOLERANCE)).size:
            actual = f"of length {lengths[off[0]]:.3g} in frame {off[0] + 1} ({len(off)} such)"
            yield "action", f"dimensions {first} to {first + 3} should be a unit quaternion, are {actual}"


def _flips(episode: Episode) -> Iterator[Problem]:
    arrays = [("actions", 1, episode.actions[1:], Layout.from_json(episode.meta.get("actions", {})).held)]
    if episode.states is not None:
        arrays.append(("states", 0, episode.states, ()))
    for name, offset, rows, others in arrays:
        for first in (first for first in quaternions(rows) if not {*range(first, first + 4)} & {*others}):
            part = rows[:, first : first + 4]
            if (flips := np.flatnonzero((part[1:] * part[:-1]).sum(1) < 0)).size:
                where = f"frame {flips[0] + 1 + offset} ({len(flips)} such)"
                yield "quaternion-flip", f"{name}: dimensions {first} to {first + 3} at {where}"


def _segments(episode: Episode) -> Iterator[Problem]:
    for part in episode.segments:
        if not 0 <= part.start < part.end <= len(episode.timestamps):
            yield "segment", f"{part.text!r} goes from {part.start} to {part.end} of {len(episode.timestamps)} frames"


def quaternions(rows: Float[np.ndarray, "N n"]) -> list[int]:
    """Returns the first of each four consecutive columns that look like a quaternion: each row has length 1.

    A 1 or -1 beside three zeros in every row, such as a gripper's, does not count.
    """
    found: list[int] = []
    for first in range(rows.shape[1] - 3 if len(rows) else 0):
        free, part = not found or first >= found[-1] + 4, rows[:, first : first + 4]
        turns = (np.abs(part).max(1) < 1 - _TOLERANCE).any()
        if free and turns and (np.abs(np.linalg.norm(part, axis=1) - 1) < _TOLERANCE).all():
            found.append(first)
    return found


def _sample(count: int, frames: int) -> list[int]:
    """Spreads ``frames`` indices evenly over ``count``, including the first and the last; 0 means all."""
    return list(range(count)) if not frames else np.unique(np.linspace(0, count - 1, frames).astype(int)).tolist()


def _pictures(
    name: str, frames: Frames, wanted: int, moving: bool
) -> tuple[list[Problem], UInt8[np.ndarray, "H W 3"] | None]:
    """Returns the problem of a camera's pictures, if any, and the first picture.

    Args:
        moving: whether the robot moves, so that pictures should change.
    """
    chosen, first, blank, changes = _sample(len(frames), wanted), None, [], False
    try:
        if isinstance(frames, VideoFrames) and (wrong := misread(frames.path)) is not None:
            return [("seeking", f"{name}: frame {wrong} is not that of decoding in order; {_REWRITE}")], first
        for start in range(0, len(chosen), _CHUNK):
            numbers = chosen[start : start + _CHUNK]
            pictures = frames.read(numbers)
            first = pictures[0] if first is None else first
            flat = np.ptp(pictures.reshape(len(pictures), -1, 3), axis=1).max(1) == 0
            blank += [number for number, one_colour in zip(numbers, flat, strict=True) if one_colour]
            changes = changes or bool((pictures != first).any())
    except EpisodeError as error:
        return [("undecodable", f"{name}: {' '.join(str(error).split())}")], first
    problem = ""
    if blank:
        problem = f"frame {blank[0]} is of one colour ({len(blank)} of {len(chosen)} checked)"
    elif moving and not changes and len(chosen) > 1:
        problem = f"{len(chosen)} pictures are all the same, though actions are not zero"
    return [("camera", f"{name}: {problem}")] if problem else [], first


def _depth(name: str, maps: Depths, wanted: int) -> Iterator[Problem]:
    try:
        for number in _sample(len(maps), wanted):
            (depth,) = maps.read([number])
            bad = not np.isfinite(depth).all() or depth.min() < 0
            if bad or not depth.any():
                problem = "values that are negative or not finite" if bad else "no value above 0"
                yield "depth", f"{name}: frame {number} has {problem}"
                return
    except EpisodeError as error:
        yield "undecodable", f"depth {name}: {error}"
