"""The last stage: the windows of an episode that are kept, as clips of one length and size, one at a time.

It reads what the stages before it left, as far as they were run, each record of which says of which frames it is:

* ``shots``: ``spans`` int64 (S, 2), first frame and the one after the last.
* ``motion``: ``motion`` float32 (N,), ``high`` of :class:`rsjax.ingest.annotators.protocols.Motion`.
* ``depth``: ``first``, ``depth`` float (n, H, W) of the frames from ``first`` on, in order, and its ``unit``.
* ``tracks``: ``first``, ``points`` float (P, n, 2) as in :class:`rsjax.clip.Clip`, and ``visible`` bool (P, n).
* ``semantics``: ``task``, ``scene``, ``segments`` (a list of [start, end, text, skill]) and ``key_frames``.

Axes: N recorded frames, n of some part of them, T frames of a clip, P points, N₀ tracks of a clip, S×S a clip's pixels.
"""

from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from rsjax.config import require, to_dict
from rsjax.data.codec import Record
from rsjax.data.normalization import Statistics
from rsjax.data.store import Source
from rsjax.ingest.actions import ActionConfig, Layout, sampled_actions
from rsjax.ingest.annotators.categories import UNKNOWN, CategoryConfig
from rsjax.ingest.annotators.depth import FilledDepths
from rsjax.ingest.annotators.protocols import Tracked
from rsjax.ingest.annotators.tracks import window_tracks
from rsjax.ingest.episode import Episode, EpisodeError, Segment
from rsjax.ingest.jobs.work_items import Inputs, Summary, Work
from rsjax.ingest.stored import StoredDepths, StoredTracks
from rsjax.ingest.windows import (
    Span,
    WindowConfig,
    cut_spans,
    index_windows,
    judge,
    segment_at,
    starts_by_reason,
    tally,
)


@dataclass(frozen=True)
class ClipConfig:
    """What a clip is made of."""

    windows: WindowConfig = field(default_factory=WindowConfig)
    image_size: int = 64  # pixels; pictures of another shape are squeezed into the square
    tracks: int = 256  # N₀
    camera: str = ""  # none: the episode's first
    recorded_depth: bool = True  # take the depth that the data set has
    most_holes: float = 0.5  # of a recorded depth map; holes are filled from the nearest measured pixel
    actions: ActionConfig = field(default_factory=ActionConfig)
    categories: CategoryConfig = field(default_factory=CategoryConfig)

    def __post_init__(self) -> None:
        require(8 <= self.image_size <= 4096, f"--image-size is {self.image_size}; choose one from 8 to 4096")
        require(1 <= self.tracks <= 65536, f"--points is {self.tracks}; choose a number from 1 to 65536")
        require(0 <= self.most_holes <= 1, f"most_holes is {self.most_holes}; it is a share of the pixels, 0 to 1")


@dataclass(frozen=True)
class ClipStage:
    """The stage ``clips``, of :class:`rsjax.ingest.jobs.work_items.Stage`."""

    config: ClipConfig
    needs: tuple[str, ...] = ()
    name: str = "clips"
    version: int = 2
    cpus: float = 1.0
    gpus: float = 0.0

    def params(self) -> dict[str, Any]:
        return to_dict(self.config)

    def open(self) -> Work:
        return self._work

    def _work(self, episode: Episode, inputs: Inputs) -> Generator[Record, None, Summary]:
        return (yield from cut(Annotated.load(episode, inputs), self.config))


@dataclass(frozen=True)
class Annotated:
    """An episode and what the stages before found in it; None or empty where they were not run."""

    episode: Episode
    shots: Sequence[Span] = ()
    motion: Float[np.ndarray, " N"] | None = None
    depth: Source | None = None
    tracks: Source | None = None
    task: str = ""
    scene: str = ""
    segments: tuple[Segment, ...] = ()
    key_frames: tuple[int, ...] = ()

    @classmethod
    def load(cls, episode: Episode, inputs: Inputs) -> "Annotated":
        """Out of the stages' records; words are the data set's own where ``semantics`` was not run."""
        fields: dict[str, Any] = {name: inputs[name] for name in ("depth", "tracks") if name in inputs}
        fields |= {"task": episode.task, "scene": str(episode.meta.get("scene", "")), "segments": episode.segments}
        if "shots" in inputs:
            fields["shots"] = [(int(first), int(end)) for first, end in inputs["shots"][0]["spans"]]
        if "motion" in inputs:
            fields["motion"] = inputs["motion"][0]["motion"]
        if "semantics" in inputs:
            record = inputs["semantics"][0]
            fields |= {name: record[name] for name in ("task", "scene")}
            fields["segments"] = tuple(Segment(*row) for row in record["segments"])
            fields["key_frames"] = tuple(record["key_frames"])
        return cls(episode, **fields)


def cut(annotated: Annotated, config: ClipConfig) -> Generator[Record, None, Summary]:
    """The clips of an episode, as records of :class:`rsjax.clip.Clip`; ``depth`` is None where there is none.

    Returns:
        ``windows`` (how many are kept, and left out by reason), ``left_out`` (their first frames by reason),
        ``short`` (how many ``spans`` are too short for a window, the ``longest`` of all in recorded frames, what a
        ``window`` takes, and the ``cure``, in words), ``actions`` (statistics of the clips' actions), ``action_dim``,
        ``depth`` (its range), ``depth_unit`` ("metres" or "relative"; both None without depth), ``success`` (clips that
        end so; None where the data set does not say).

    Raises:
        EpisodeError: no such camera, or pictures, depth or annotations that cannot be read or do not fit.
    """
    episode, windows = annotated.episode, config.windows
    camera = _camera(episode, config.camera)
    spans = cut_spans(len(episode.timestamps), annotated.shots, annotated.segments, windows)
    index = index_windows(episode.fps, spans, windows)
    motion = _per_frame("motion", annotated.motion, episode)
    reasons = judge(index, episode.timestamps, motion, annotated.key_frames, windows)
    views = _Views(annotated, camera, config)
    stored = None if annotated.tracks is None else StoredTracks(annotated.tracks)
    statistics: Statistics | None = None
    near, far, succeeded = np.inf, 0.0, 0
    for number in [number for number, reason in enumerate(reasons) if not reason]:
        frames = index.frames(number)
        tracks = _tracks(stored, frames, config.tracks)
        if tracks is None:
            reasons[number] = "no track"
            continue
        rgb, depth = views.read(frames)
        layout = Layout.from_json(episode.meta.get("actions", {}))
        actions = sampled_actions(episode.actions, frames, config.actions, layout)
        rows = Statistics.of(actions[1:])
        statistics = statistics.merged(rows) if statistics else rows
        if depth is not None:
            near, far = min(near, float(depth.min())), max(far, float(depth.max()))
        success = _success(episode, frames)
        succeeded += bool(success[-1])
        yield {
            "rgb": rgb,
            "depth": depth,
            "actions": actions,
            "tracks": tracks.points,
            "visible": tracks.visible,
            "success": success,
            **_words(annotated, config, camera, frames, views.unit),
        }
    return {
        "windows": tally(reasons),
        "left_out": starts_by_reason(index, reasons),
        "short": {
            "spans": index.short,
            "longest": max((end - first for first, end in spans), default=0),
            **_room(index.span, episode.fps, windows),
        },
        "actions": statistics.to_json() if statistics else None,
        "action_dim": len(statistics.mean) if statistics else None,
        "depth": [near, far] if far > 0 else None,
        "depth_unit": views.unit if far > 0 else None,
        "success": succeeded if "success" in episode.meta else None,
    }


def _room(span: int, fps: float, windows: WindowConfig) -> dict[str, str]:
    """What a window takes of a recording, and how it could be less."""
    faster = 0 < windows.rate < fps
    at = f" at {windows.rate:g} Hz" if windows.rate else ""
    return {
        "window": f"{windows.frames} frames{at} take {span} of {fps:g} fps",
        "cure": f"{'raise --windows.rate or ' if faster else ''}lower --windows.frames",
    }


def _words(
    annotated: Annotated, config: ClipConfig, camera: str, frames: Int[np.ndarray, " T"], unit: str
) -> dict[str, Any]:
    """``task`` and ``provenance`` of a clip."""
    episode = annotated.episode
    segment = segment_at(annotated.segments, frames) or Segment(0, 1, "")
    task = annotated.task or segment.text
    provenance = {
        "source": episode.meta.get("source", ""),
        "episode": episode.id,
        "fingerprint": episode.fingerprint,
        "camera": camera,
        "fps": float(episode.fps),
        "frames": frames.tolist(),
        "segment": segment.text,
        "skill": segment.skill,
        "difficulty": config.categories.difficulty(task, segment.text, segment.skill),
        "scene": config.categories.scene(annotated.scene),
        "depth_unit": unit,
    }
    if annotated.motion is not None:
        provenance["motion"] = float(np.mean(annotated.motion[frames[0] + 1 : frames[-1] + 1]))
    return {"task": task, "provenance": provenance}


def words(record: Record) -> dict[str, str]:
    """A clip's labels, by which a curriculum or a split can choose."""
    columns = ("difficulty", "scene", "segment", "skill")
    return {"task": record["task"]} | {name: record["provenance"][name] or UNKNOWN for name in columns}


def _camera(episode: Episode, name: str) -> str:
    if name and name not in episode.cameras:
        there = ", ".join(episode.cameras)
        raise EpisodeError(f"cameras: episode {episode.id} has no {name!r}; it has {there}", option="--camera")
    return name or next(iter(episode.cameras))


def _per_frame(name: str, values: Float[np.ndarray, " n"] | None, episode: Episode) -> Float[np.ndarray, " N"] | None:
    if values is not None and len(values) != len(episode.timestamps):
        raise EpisodeError(f"{name}: {len(values)} values for {len(episode.timestamps)} frames; annotate it again")
    return values


def _success(episode: Episode, frames: Int[np.ndarray, " T"]) -> Bool[np.ndarray, " T"]:
    """As the data set says, by frame or for the whole; False where it does not."""
    told = np.asarray(episode.meta.get("success", False), bool)
    return told[frames] if told.ndim else np.full(len(frames), bool(told))


def _tracks(stored: StoredTracks | None, frames: Int[np.ndarray, " T"], count: int) -> Tracked | None:
    """``count`` of the points seen in a window's first frame; None where there are none.

    Without a tracks stage they are zeros that are never visible.
    """
    if stored is None:
        return Tracked(np.zeros((count, len(frames), 2), np.float32), np.zeros((count, len(frames)), bool))
    found = stored.at(frames)
    if found is None or not found.visible[:, 0].any():
        return None
    return window_tracks(found, np.arange(len(frames)), count)


class _Views:
    """Pictures and depth at the clips' size, each read once for the overlapping windows that need it, in order.

    Attributes:
        unit: "metres" or "relative" (see :mod:`rsjax.ingest.annotators.depth`); "" without depth.
    """

    def __init__(self, annotated: Annotated, camera: str, config: ClipConfig) -> None:
        episode = annotated.episode
        self.unit, self._size, self._pictures = "", config.image_size, episode.cameras[camera]
        self._rgb: dict[int, np.ndarray] = {}
        self._depth: dict[int, np.ndarray] = {}
        self._maps: Callable[[list[int]], Iterable[np.ndarray]] | None = None
        if camera in episode.depth and config.recorded_depth:  # what was measured counts before what was estimated
            where = f"episode {episode.id}: depth of {camera}"
            self._maps, self.unit = FilledDepths(episode.depth[camera], config.most_holes, where).read, "metres"
        elif annotated.depth is not None and len(annotated.depth):
            estimated = StoredDepths(annotated.depth, episode)
            self._maps, self.unit = estimated.read, estimated.unit

    def read(
        self, frames: Int[np.ndarray, " T"]
    ) -> tuple[UInt8[np.ndarray, "T S S 3"], Float32[np.ndarray, "T S S"] | None]:
        """Of these frames; no depth where there is none."""
        self._rgb = self._moved(self._rgb, frames, self._pictures.read)
        rgb = np.stack([self._rgb[frame] for frame in frames.tolist()])
        if self._maps is None:
            return rgb, None
        self._depth = self._moved(self._depth, frames, self._maps)
        return rgb, np.stack([self._depth[frame] for frame in frames.tolist()])

    def _moved(
        self, kept: dict[int, np.ndarray], frames: Int[np.ndarray, " T"], read: Callable[[list[int]], Iterable[Any]]
    ) -> dict[int, np.ndarray]:
        """What is kept, without the frames before the window, and with those of it that were missing."""
        missing = [frame for frame in frames.tolist() if frame not in kept]
        later = {frame: picture for frame, picture in kept.items() if frame >= frames[0]}
        new = read(missing) if missing else ()
        return later | {frame: resized(picture, self._size) for frame, picture in zip(missing, new, strict=True)}


def resized(picture: np.ndarray, size: int) -> np.ndarray:
    """A picture as a mean over areas; a depth map by its nearest values, so that none between two things is made up."""
    method = cv2.INTER_AREA if picture.ndim == 3 else cv2.INTER_NEAREST_EXACT
    return cv2.resize(picture, (size, size), interpolation=method)
