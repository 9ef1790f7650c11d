"""Checks a whole data set, and lists the episodes that should be left out.

Each episode is checked by itself, and then compared with the others by its statistics alone, so that memory does not
depend on the pictures. Its reader has checked before that every array has a row for each frame, that values are finite
and that time increases. The ingest follows the list (:func:`select`).

Axes: N recorded frames, A action and S state dimensions.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8

from rsjax.config import require
from rsjax.data.store import MANIFEST
from rsjax.errors import did_you_mean
from rsjax.files import disk_guard, parse_json, regular, write_atomically
from rsjax.processes import WorkerDied, run_items
from rsjax.tools.ingest.actions import ActionLayout
from rsjax.tools.ingest.episode import (
    Depths,
    Episode,
    EpisodeError,
    EpisodeRef,
    EpisodeSource,
    Frames,
    SourceError,
    fingerprint,
)
from rsjax.tools.ingest.formats import FORMATS, open_source
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
_TOLERANCE = 1e-3  # of a unit quaternion's length, and of π

Problem = tuple[str, str]  # one of KINDS, and what is wrong where
FEWEST = 5  # with fewer episodes, they are not compared with what is usual

_SELECTION_FORMAT = 1


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


Checked = tuple[EpisodeRef, list[Finding], EpisodeStats | None, str]  # the last: what the reader repaired


def check_episode(episode: Episode, limits: Thresholds) -> tuple[list[Finding], EpisodeStats]:
    """Returns all problems found in one episode by itself, and its statistics."""
    problems = [*_time(episode, limits.gap), *_actions(episode), *_flips(episode)]
    for part in episode.segments:
        if not 0 <= part.start < part.end <= len(episode.timestamps):
            extent = f"from {part.start} to {part.end} of {len(episode.timestamps)} frames"
            problems.append(("segment", f"{part.text!r} goes {extent}"))
    first: UInt8[np.ndarray, "H W 3"] | None = None
    for name, frames in episode.cameras.items():
        more, picture = _pictures(name, frames, limits.frames, moving=bool(episode.actions[1:].any()))
        problems += more
        if first is None:
            first = picture
    for name, maps in episode.depth.items():
        problems += _depth(name, maps, limits.frames)
    if not episode.task.strip():
        problems.append(("no-task", "its task is empty"))
    if episode.states is None:
        states = np.zeros((0, 0), np.float32)
    else:
        states = episode.states
    digest = None
    if first is not None:
        digest = hashlib.sha256(first.tobytes() + episode.actions.tobytes() + states.tobytes()).digest()
    reach = _largest(episode.actions[1:])
    jump = _largest(state_steps(states))
    stats = EpisodeStats(digest, tuple(episode.cameras), reach, jump)
    return [Finding(episode.id, kind, detail) for kind, detail in problems], stats


def state_steps(states: Float[np.ndarray, "N S"]) -> Float[np.ndarray, "M S"]:
    """Returns the size of each step; one within ±π counts as that of an angle if this is smaller, across π."""
    steps = np.abs(np.diff(states, axis=0))
    ends = np.maximum(np.abs(states[1:]), np.abs(states[:-1]))
    across = np.minimum(steps, np.abs(2 * np.pi - steps))
    return np.where(ends < np.pi + _TOLERANCE, across, steps)


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
    layout = ActionLayout.from_json(episode.meta.get("actions", {}))
    for doubt in layout.unclear:
        yield "action", f"{doubt}, so it is not a step: declare kind and held"
    for first in layout.quaternions:
        lengths = np.linalg.norm(rows[:, first : first + 4], axis=1)
        if (off := np.flatnonzero(np.abs(lengths - 1) > _TOLERANCE)).size:
            actual = f"of length {lengths[off[0]]:.3g} in frame {off[0] + 1} ({len(off)} such)"
            yield "action", f"dimensions {first} to {first + 3} should be a unit quaternion, are {actual}"


def _flips(episode: Episode) -> Iterator[Problem]:
    arrays = [("actions", 1, episode.actions[1:], ActionLayout.from_json(episode.meta.get("actions", {})).held)]
    if episode.states is not None:
        arrays.append(("states", 0, episode.states, ()))
    for name, offset, rows, others in arrays:
        for first in (first for first in quaternions(rows) if not {*range(first, first + 4)} & {*others}):
            part = rows[:, first : first + 4]
            if (flips := np.flatnonzero((part[1:] * part[:-1]).sum(1) < 0)).size:
                where = f"frame {flips[0] + 1 + offset} ({len(flips)} such)"
                yield "quaternion-flip", f"{name}: dimensions {first} to {first + 3} at {where}"


def quaternions(rows: Float[np.ndarray, "N n"]) -> list[int]:
    """Returns the first of each four consecutive columns that look like a quaternion: each row has length 1.

    A 1 or -1 beside three zeros in every row, such as a gripper's, does not count.
    """
    firsts: list[int] = []
    for first in range(rows.shape[1] - 3 if len(rows) else 0):
        free = not firsts or first >= firsts[-1] + 4
        part = rows[:, first : first + 4]
        turns = (np.abs(part).max(1) < 1 - _TOLERANCE).any()
        if free and turns and (np.abs(np.linalg.norm(part, axis=1) - 1) < _TOLERANCE).all():
            firsts.append(first)
    return firsts


def _sample(count: int, frames: int) -> list[int]:
    """Spreads ``frames`` indices evenly over ``count``, including the first and the last; 0 means all."""
    if not frames or frames >= count:
        return list(range(count))
    return np.unique(np.linspace(0, count - 1, frames).astype(int)).tolist()


def _pictures(
    name: str, frames: Frames, wanted: int, moving: bool
) -> tuple[list[Problem], UInt8[np.ndarray, "H W 3"] | None]:
    """Returns the problem of a camera's pictures, if any, and the first picture.

    Args:
        moving: whether the robot moves, so that pictures should change.
    """
    chosen = _sample(len(frames), wanted)
    first = None
    blank = []
    changes = False
    try:
        if isinstance(frames, VideoFrames) and (wrong := misread(frames.path)) is not None:
            return [("seeking", f"{name}: frame {wrong} is not that of decoding in order; {_REWRITE}")], first
        for start in range(0, len(chosen), _CHUNK):
            numbers = chosen[start : start + _CHUNK]
            pictures = frames.read(numbers)
            if first is None:
                first = pictures[0]
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
                problem = "no value above 0"
                if bad:
                    problem = "values that are negative or not finite"
                yield "depth", f"{name}: frame {number} has {problem}"
                return
    except EpisodeError as error:
        yield "undecodable", f"depth {name}: {error}"


@dataclass(frozen=True)
class Diagnosis:
    """The result of checking a data set.

    Attributes:
        refs: every episode's id and fingerprint, in order.
        findings: in the order of the episodes.
        mended: id and notes of each episode in which the reader repaired something.
        unread: ids of the episodes that could not be read or checked.
    """

    refs: tuple[tuple[str, str], ...]
    findings: tuple[Finding, ...]
    mended: tuple[tuple[str, str], ...] = ()
    unread: frozenset[str] = frozenset()

    def counts(self) -> dict[str, int]:
        """Counts the episodes that have each kind of finding, in the order of :data:`KINDS`."""
        episodes = Counter(name for name, _ in self.refs)  # several may share one id
        affected: Counter[str] = Counter()
        for name, kind in {(finding.episode, finding.kind) for finding in self.findings}:
            affected[kind] += episodes[name]
        return {kind: affected[kind] for kind in KINDS if affected[kind]}

    def usual(self) -> list[str]:
        """Returns the kinds of finding that every episode has, if all can be read and decoded: they may be intended."""
        if self.unread:
            return []
        return [kind for kind, count in self.counts().items() if count == len(self.refs) and kind != "undecodable"]

    def reasons(self) -> dict[str, list[str]]:
        """Returns the findings of each episode that has any, as texts by its id."""
        reasons: dict[str, list[str]] = {}
        for finding in self.findings:
            reasons.setdefault(finding.episode, []).append(f"{finding.kind}: {finding.detail}")
        return reasons


def open_any(what: str, path: Path | None, **options: object) -> EpisodeSource:
    """Opens the ``STORE`` or the ``FORMAT PATH`` of a command line.

    Args:
        what: a store's directory, or a format's name.
        path: the data set's path, if ``what`` is a format.
        options: options of the format.

    Raises:
        SourceError: ``what`` is neither.
    """
    if path is not None:
        return open_source(what, path, **options)
    if what in FORMATS:
        raise SourceError(f"{what} is a format; say where the data set is: {what} PATH")
    if not (Path(what) / MANIFEST).exists():
        raise SourceError(
            f"{what}: no store (it has no {MANIFEST}){did_you_mean(what, FORMATS)}; "
            f"name a store, or a format and a path: {', '.join(FORMATS)}"
        )
    return open_source("sim", what, **options)


def diagnose(
    source: EpisodeSource,
    limits: Thresholds,
    ignored: Sequence[str] = (),
    progress: Callable[[int], None] = lambda done: None,
    workers: int = 1,
) -> Diagnosis:
    """Checks every episode of a data set.

    Args:
        limits: limits of the checks.
        ignored: kinds of findings to leave out.
        progress: called with the number of episodes done.
        workers: number of processes; 1: only this one.

    Raises:
        SourceError: the data set cannot be listed or is empty, or an ignored kind does not exist.
    """
    for kind in ignored:
        if kind not in KINDS:
            raise SourceError(f"no kind {kind!r} to ignore{did_you_mean(kind, KINDS)}; there are {', '.join(KINDS)}")
    refs: list[tuple[str, str]] = []
    findings: dict[str, list[Finding]] = {}  # by episode, in their order
    stats: dict[str, EpisodeStats] = {}
    mended: list[tuple[str, str]] = []
    unread = set[str]()
    for ref, problems, own, notes in _check_all(source, limits, workers, progress):
        if ref.id in findings:
            findings[ref.id].append(Finding(ref.id, "duplicate", "another episode has the same id"))
        findings.setdefault(ref.id, []).extend(problems)
        if own is not None:
            stats.setdefault(ref.id, own)
        else:
            unread.add(ref.id)
        if notes:
            mended.append((ref.id, notes))
        refs.append((ref.id, ref.fingerprint))
    if not refs:
        raise SourceError(f"{source.name}: the data set has no episodes; check the path and the options")
    for finding in compare(stats, limits.unusual):
        findings[finding.episode].append(finding)
    kept = (finding for one in findings.values() for finding in one if finding.kind not in ignored)
    return Diagnosis(tuple(refs), tuple(kept), tuple(mended), frozenset(unread))


def _check_all(
    source: EpisodeSource, limits: Thresholds, workers: int, progress: Callable[[int], None]
) -> list[Checked]:
    """Checks every episode and returns the results in the order of the episodes."""
    checked: dict[int, Checked] = {}

    def settle(numbered: tuple[int, EpisodeRef], result: Checked | WorkerDied) -> None:
        number, ref = numbered
        if isinstance(result, WorkerDied):
            result = ref, [Finding(ref.id, "unreadable", str(result))], None, ""
        checked[number] = result
        progress(len(checked))

    numbered = enumerate(source.episodes())
    run_items(partial(_open_check, source, limits), numbered, workers if workers > 1 else 0, settle)
    return [checked[number] for number in range(len(checked))]


def _open_check(source: EpisodeSource, limits: Thresholds) -> Callable[[tuple[int, EpisodeRef]], Checked]:
    """Returns what checks an episode in a worker process."""

    def check(numbered: tuple[int, EpisodeRef]) -> Checked:
        ref = numbered[1]
        try:
            episode = source.read(ref)
            problems, stats = check_episode(episode, limits)
            repaired = []  # by the reader
            for name, value in episode.meta.get("notes", {}).items():
                parts = value
                if isinstance(value, dict):
                    parts = [f"{key} {number}" for key, number in value.items()]
                if isinstance(parts, list):
                    parts = ", ".join(map(str, parts))
                repaired.append(f"{name.replace('_', ' ')}: {parts}")
            return ref, problems, stats, "; ".join(repaired)
        except Exception as error:  # an error in one episode must not hide the others
            line = " ".join(str(error).split())
            kind = "unreadable"
            detail = f"{type(error).__name__}: {line}"
            if isinstance(error, EpisodeError):
                kind = error.kind
                detail = line
            return ref, [Finding(ref.id, kind, detail)], None, ""

    return check


def compare(stats: dict[str, EpisodeStats], unusual: float) -> Iterator[Finding]:
    """Yields findings on episodes that differ from the others or duplicate another one.

    Args:
        stats: each episode's statistics by its id.
        unusual: as in :class:`Thresholds`.
    """
    by_digest: dict[bytes, str] = {}
    for name, own in stats.items():
        if own.digest is not None and (first := by_digest.setdefault(own.digest, name)) != name:
            yield Finding(name, "duplicate", f"its actions, states and first picture are those of {first}")
    if len(stats) < FEWEST:
        return
    usual = Counter(camera for own in stats.values() for camera in own.cameras)
    wanted = {camera for camera, count in usual.items() if count > len(stats) / 2}
    for name, own in stats.items():
        if lacking := sorted(wanted - set(own.cameras)):
            yield Finding(name, "camera", f"has no {', '.join(lacking)}, which most episodes have")
    yield from _outliers("action", {name: own.reach for name, own in stats.items()}, "reaches", unusual)
    yield from _outliers("state", {name: own.jump for name, own in stats.items()}, "jumps by", unusual)


def _outliers(kind: str, figures: dict[str, Float32[np.ndarray, " n"]], verb: str, unusual: float) -> Iterator[Finding]:
    """Yields findings on episodes whose figures differ in length from most, or are far above the median."""
    width = Counter(len(figure) for figure in figures.values()).most_common(1)[0][0]
    alike = {name: figure for name, figure in figures.items() if len(figure) == width}
    for name, figure in figures.items():
        if name not in alike:
            yield Finding(name, kind, f"has {len(figure)} dimensions, most episodes have {width}")
    middle = np.median(np.stack(list(alike.values())), axis=0)
    for name, figure in alike.items():
        times = np.divide(figure, middle, out=np.zeros(width), where=middle > 0)
        if width and times.max() > unusual:
            worst = int(times.argmax())
            yield Finding(
                name, kind, f"dimension {worst} {verb} {figure[worst]:.4g}, {times[worst]:.0f} times the usual"
            )


def write_selection(
    path: Path, about: str, refs: tuple[tuple[str, str], ...], reasons: Mapping[str, list[str]]
) -> tuple[int, int]:
    """Writes which episodes are kept, which are left out, and why.

    Args:
        path: the list, a JSON file.
        about: the data set, for human readers of the list.
        refs: every episode's id and fingerprint.
        reasons: why episodes are left out, by id.

    Returns:
        How many episodes are kept, and how many are left out.

    Raises:
        FileError: the file cannot be written.
    """
    kept = [{"id": name, "fingerprint": mark} for name, mark in refs if name not in reasons]
    out = [{"id": name, "fingerprint": mark, "reasons": reasons[name]} for name, mark in refs if name in reasons]
    content = {"format": _SELECTION_FORMAT, "data_set": about, "kept": kept, "left_out": out}
    with disk_guard(path):
        write_atomically(path, json.dumps(content, indent=1).encode())
    return len(kept), len(out)


@dataclass
class Selected:
    """A source that refuses to read the episodes that a list leaves out; the error gives the reasons.

    It still lists these episodes. An episode that has changed since the list was written is read.

    Attributes:
        source: the source that is read.
        reasons: why episodes are left out, by id and fingerprint.
        name: name of the source.
    """

    source: EpisodeSource
    reasons: dict[tuple[str, str], str]
    name: str

    def episodes(self) -> Iterator[EpisodeRef]:
        """Lists all episodes; one that is left out gets another fingerprint, so that earlier work on it is not used."""
        for ref in self.source.episodes():
            why = self.reasons.get((ref.id, ref.fingerprint))
            if why is None:
                yield ref
            else:
                yield EpisodeRef(ref.id, fingerprint((), ref.fingerprint, why), {"left_out": why})

    def read(self, ref: EpisodeRef) -> Episode:
        """Reads one episode; raises :class:`EpisodeError` with the reasons if it is left out."""
        if "left_out" in ref.location:
            raise EpisodeError(f"{ref.id}: left out by the list: {ref.location['left_out']}")
        return self.source.read(ref)


def select(source: EpisodeSource, path: Path) -> Selected:
    """Returns a source that refuses the episodes that the list at ``path`` leaves out.

    Raises:
        SourceError: the list cannot be read, or is about other episodes or about these read with other options.
    """
    try:
        content = parse_json(regular(path).read_bytes())
        if content["format"] != _SELECTION_FORMAT:
            raise ValueError(f"format {content['format']}, this code reads format {_SELECTION_FORMAT}")
        reasons = {_key(entry): "; ".join(map(str, entry["reasons"])) for entry in content["left_out"]}
        listed = {*reasons, *map(_key, content["kept"])}
    except FileNotFoundError as error:
        raise SourceError(f"{path}: not there; make it with rsjax doctor … --fix {path.name}") from error
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise SourceError(f"{path}: not a list of rsjax doctor ({error}); make it again with --fix") from error
    names = {name for name, _ in listed}
    known = False
    for ref in source.episodes():
        known = known or ref.id in names
        if (ref.id, ref.fingerprint) in listed:
            return Selected(source, reasons, source.name)
    if known:
        raise SourceError(
            f"{path}: the data set was read with other options then, or all its files have changed; run "
            f"rsjax doctor --fix again, with the same --option"
        )
    raise SourceError(f"{path}: names no episode of this data set; give the list that was made for it")


def _key(entry: Mapping[str, object]) -> tuple[str, str]:
    return str(entry["id"]), str(entry["fingerprint"])
