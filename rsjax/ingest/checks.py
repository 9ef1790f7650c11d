"""What can be wrong with an episode that its reader accepts, and the figures by which it is compared with the others.

Axes: N recorded frames, A action and S state dimensions.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8

from rsjax.config import require
from rsjax.ingest.actions import Layout
from rsjax.ingest.episode import Depths, Episode, EpisodeError, Frames

KINDS = {
    "unreadable": "the reader refuses the episode for another reason",
    "camera": "pictures are missing that other episodes have, or are blank, or never change",
    "undecodable": "a video, picture or depth map is missing or cannot be decoded",
    "length": "actions, states or pictures are not as many as the timestamps",
    "not-finite": "values are NaN or infinite",
    "time": "time stands still, jumps, or does not go with fps",
    "action": "actions are all zero, of another width, or far beyond the usual",
    "state": "states jump, or are of another width",
    "quaternion-flip": "a quaternion changes its sign from one frame to the next",
    "depth": "depth is negative, or nothing was measured",
    "segment": "a named part lies outside the episode, or is empty",
    "no-task": "nothing says what the robot is to do",
    "duplicate": "the same as another episode, or called the same",
}
_CHUNK = 16  # pictures decoded at once
_UNIT = 1e-3  # by how much a unit quaternion's length may be off


@dataclass(frozen=True)
class Finding:
    """Something wrong.

    Attributes:
        episode: its id.
        kind: one of :data:`KINDS`.
        detail: what and where, in one line.
    """

    episode: str
    kind: str
    detail: str


@dataclass(frozen=True)
class Thresholds:
    """From where on something is wrong.

    Attributes:
        frames: pictures of each camera that are decoded, evenly spread over the episode; 0: all.
        gap: time between two frames, relative to 1 / fps.
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
class Vitals:
    """What is kept of an episode to compare it with the others.

    Attributes:
        digest: of its actions, states and first picture; None where there is no such picture.
        cameras: their names.
        reach: largest absolute action of each dimension.
        jump: largest step of each dimension of the state.
    """

    digest: bytes | None
    cameras: tuple[str, ...]
    reach: Float32[np.ndarray, " A"]
    jump: Float32[np.ndarray, " S"]


def look_at(episode: Episode, limits: Thresholds) -> tuple[list[Finding], Vitals]:
    """Everything that is wrong with one episode by itself, and its figures."""
    found: list[tuple[str, str]] = []
    for check in (_lengths, _finite, _segments):
        found += check(episode)
    found += _time(episode, limits.gap)
    found += _actions(episode)
    found += _flips(episode)
    first: UInt8[np.ndarray, "H W 3"] | None = None
    for name, frames in episode.cameras.items():
        told, picture = _pictures(name, frames, limits.frames, moving=bool(episode.actions[1:].any()))
        found += told
        first = picture if first is None else first
    for name, maps in episode.depth.items():
        found += _depth(name, maps, limits.frames)
    if not episode.cameras:
        found.append(("camera", "has no camera"))
    if not episode.task.strip():
        found.append(("no-task", "its task is empty"))
    return [Finding(episode.id, kind, detail) for kind, detail in found], _vitals(episode, first)


def _vitals(episode: Episode, first: UInt8[np.ndarray, "H W 3"] | None) -> Vitals:
    arrays = [episode.actions, *([] if episode.states is None else [episode.states])]
    digest = None
    if first is not None:
        hashed = hashlib.sha256(first.tobytes())
        for array in arrays:
            hashed.update(array.tobytes())
        digest = hashed.digest()
    states = np.zeros((0, 0), np.float32) if episode.states is None else episode.states
    return Vitals(digest, tuple(episode.cameras), _largest(episode.actions[1:]), _largest(np.diff(states, axis=0)))


def _largest(rows: Float[np.ndarray, "N n"]) -> Float32[np.ndarray, " n"]:
    """Largest absolute value of each column, 0 where there are no rows."""
    return np.abs(rows).max(0, initial=0).astype(np.float32)


def _lengths(episode: Episode) -> Iterator[tuple[str, str]]:
    count = len(episode.timestamps)
    lengths = {"actions": len(episode.actions)} | ({} if episode.states is None else {"states": len(episode.states)})
    lengths |= {f"camera {name}": len(frames) for name, frames in episode.cameras.items()}
    lengths |= {f"depth {name}": len(maps) for name, maps in episode.depth.items()}
    if count < 2:
        yield "length", f"has {count} frames, so nothing happens in it"
    for name, length in lengths.items():
        if length != count:
            yield "length", f"{name}: {length} rows, timestamps {count}"


def _finite(episode: Episode) -> Iterator[tuple[str, str]]:
    arrays = {"timestamps": episode.timestamps, "actions": episode.actions, "states": episode.states}
    for name, array in arrays.items():
        if array is not None and (bad := np.argwhere(~np.isfinite(array))).size:
            yield "not-finite", f"{name}: {len(bad)} values, the first in frame {bad[0][0]}"


def _segments(episode: Episode) -> Iterator[tuple[str, str]]:
    for part in episode.segments:
        if not 0 <= part.start < part.end <= len(episode.timestamps):
            yield "segment", f"{part.text!r} goes from {part.start} to {part.end} of {len(episode.timestamps)} frames"


def _time(episode: Episode, gap: float) -> Iterator[tuple[str, str]]:
    steps = np.diff(episode.timestamps)
    if not len(steps) or not np.isfinite(steps).all():
        return
    if (back := np.flatnonzero(steps <= 0)).size:
        yield "time", f"does not increase at frame {back[0] + 1} ({len(back)} such)"
    if abs(np.median(steps) * episode.fps - 1) > 0.1:
        yield "time", f"frames are {np.median(steps):.4g} s apart (median), fps is {episode.fps:g}"
    elif (long := np.flatnonzero(steps > gap / episode.fps)).size:
        yield "time", f"{steps[long[0]]:.3g} s before frame {long[0] + 1} at {episode.fps:g} fps ({len(long)} such)"


def _actions(episode: Episode) -> Iterator[tuple[str, str]]:
    rows = episode.actions[1:]
    if len(rows) and not rows.any():
        yield "action", "all are zero"
    for first in Layout.from_json(episode.meta.get("actions", {})).quaternions:
        lengths = np.linalg.norm(rows[:, first : first + 4], axis=1)
        if (off := np.flatnonzero(np.abs(lengths - 1) > _UNIT)).size:
            told = f"of length {lengths[off[0]]:.3g} in frame {off[0] + 1} ({len(off)} such)"
            yield "action", f"dimensions {first} to {first + 3} should be a unit quaternion, are {told}"


def _flips(episode: Episode) -> Iterator[tuple[str, str]]:
    held = Layout.from_json(episode.meta.get("actions", {})).held
    arrays = [("actions", 1, episode.actions[1:], held)]
    if episode.states is not None:
        arrays.append(("states", 0, episode.states, ()))
    for name, offset, rows, others in arrays:
        for first in (first for first in quaternions(rows) if not {*range(first, first + 4)} & {*others}):
            part = rows[:, first : first + 4]
            if (flips := np.flatnonzero((part[1:] * part[:-1]).sum(1) < 0)).size:
                where = f"frame {flips[0] + 1 + offset} ({len(flips)} such)"
                yield "quaternion-flip", f"{name}: dimensions {first} to {first + 3} at {where}"


def quaternions(rows: Float[np.ndarray, "N n"]) -> list[int]:
    """Where four columns in a row are a unit quaternion in every row, as far as one can see.

    A gripper's 1 or -1 after a turn of three zeros is none, though it is as long.
    """
    found: list[int] = []
    for first in range(rows.shape[1] - 3 if len(rows) else 0):
        free, part = not found or first >= found[-1] + 4, rows[:, first : first + 4]
        turns = (np.abs(part).max(1) < 1 - _UNIT).any()
        if free and turns and (np.abs(np.linalg.norm(part, axis=1) - 1) < _UNIT).all():
            found.append(first)
    return found


def _chosen(count: int, frames: int) -> list[int]:
    """Frames evenly spread over an episode, its first and last among them."""
    return list(range(count)) if not frames else np.unique(np.linspace(0, count - 1, frames).astype(int)).tolist()


def _pictures(
    name: str, frames: Frames, wanted: int, moving: bool
) -> tuple[list[tuple[str, str]], UInt8[np.ndarray, "H W 3"] | None]:
    """What is wrong with a camera's pictures, and the first of them.

    Args:
        moving: whether the robot was told to move, so that pictures should change.
    """
    if not len(frames):
        return [("camera", f"{name}: has no pictures")], None
    chosen, first, blank, changes = _chosen(len(frames), wanted), None, [], False
    try:
        for start in range(0, len(chosen), _CHUNK):
            numbers = chosen[start : start + _CHUNK]
            pictures = frames.read(numbers)
            first = pictures[0] if first is None else first
            flat = np.ptp(pictures.reshape(len(pictures), -1, 3), axis=1).max(1) == 0
            blank += [number for number, one_colour in zip(numbers, flat, strict=True) if one_colour]
            changes = changes or bool((pictures != first).any())
    except EpisodeError as error:
        return [("undecodable", f"{name}: {' '.join(str(error).split())}")], first
    if blank:
        return [
            ("camera", f"{name}: frame {blank[0]} is of one colour ({len(blank)} of {len(chosen)} looked at)")
        ], first
    if moving and not changes and len(chosen) > 1:
        return [("camera", f"{name}: {len(chosen)} pictures are all the same, though actions are not zero")], first
    return [], first


def _depth(name: str, maps: Depths, wanted: int) -> list[tuple[str, str]]:
    chosen = _chosen(len(maps), wanted) if len(maps) else []
    try:
        for number in chosen:
            (depth,) = maps.read([number])
            if not np.isfinite(depth).all() or depth.min() < 0:
                return [("depth", f"{name}: frame {number} has values that are negative or not finite")]
            if not depth.any():
                return [("depth", f"{name}: frame {number} has no value above 0")]
    except EpisodeError as error:
        return [("undecodable", f"depth {name}: {error}")]
    return []
