"""The annotation steps: each runs one annotator on an episode and writes records, which this module also reads.

* ``shots``: ``spans`` int64 (S, 2), the first frame and the one after the last.
* ``motion``: ``motion`` float32 (N,), ``high`` of :class:`rsjax.tools.ingest.annotators.protocols.Motion`.
* ``depth``: records of a few frames each, in order: ``first``, ``depth`` float (n, H, W) from ``first`` on, ``unit``.
* ``tracks``: a record for each shot: ``first``, ``points`` float (P, n, 2) as in :class:`rsjax.clip.Clip`, ``visible``
  bool (P, n).
* ``semantics``: ``task``, ``scene``, ``segments`` (a list of [start, end, text, skill]) and ``key_frames``.

Pictures are read a few at a time, so that their memory does not grow with the length of an episode. That of tracks
does: 9 bytes for each point of a shot and each of its frames.

Axes: N recorded frames, n some of them, T frames of a clip, H×W pixels, P points, S shots.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from rsjax.config import content_key
from rsjax.data.codec import Record
from rsjax.data.store import Source
from rsjax.tools.ingest.annotators.depth import FilledDepths
from rsjax.tools.ingest.annotators.motion import DISFlow, measure_motion
from rsjax.tools.ingest.annotators.protocols import (
    CHUNK,
    DepthEstimator,
    FlowEstimator,
    SemanticsAnnotator,
    ShotDetector,
    Tracker,
)
from rsjax.tools.ingest.annotators.semantics import OwnSemantics
from rsjax.tools.ingest.annotators.shots import HistogramShots
from rsjax.tools.ingest.annotators.tracks import LucasKanade
from rsjax.tools.ingest.episode import Depths, Episode, EpisodeError, Segment
from rsjax.tools.ingest.windows import Span
from rsjax.tools.ingest.work_items import Inputs, Records, Step


@dataclass(frozen=True)
class Annotators:
    """The method of each step; None leaves the step out."""

    shots: ShotDetector | None = field(default_factory=HistogramShots)
    motion: FlowEstimator | None = field(default_factory=DISFlow)
    depth: DepthEstimator | None = None  # a network; recorded depth needs no step
    tracks: Tracker | None = field(default_factory=LucasKanade)
    semantics: SemanticsAnnotator | None = field(default_factory=OwnSemantics)


def annotation_steps(annotators: Annotators, camera: str, cpus: float = 1.0, gpus: float = 0.0) -> tuple[Step, ...]:
    """Returns a step for each annotator, in order.

    Args:
        camera: the camera to annotate; "" is the episode's first.
        cpus: CPUs of a worker of each step, on a Ray cluster.
        gpus: GPUs of a worker of each step that has a network, on a Ray cluster.
    """
    needs: dict[str, tuple[str, ...]] = {"tracks": ("shots",), "semantics": ("motion",)}
    if _is_network(annotators.tracks):  # some of these trackers use depth
        needs["tracks"] = ("shots", "depth")
    methods = {name: method for name in _WORK if (method := getattr(annotators, name)) is not None}
    return tuple(
        Step(
            name,
            partial(_WORK[name], method, camera),
            content_key({"camera": camera} | method.params()),
            needs=tuple(need for need in needs.get(name, ()) if need in methods),
            prepare=method.load,
            cpus=cpus,
            gpus=gpus if _is_network(method) else 0.0,
        )
        for name, method in methods.items()
    )


def _is_network(annotator: object) -> bool:
    return hasattr(annotator, "device")


def camera_of(episode: Episode, name: str) -> str:
    """Returns the camera of this name, or the episode's first for ""; LeRobot's full key of a column is a name too.

    Raises:
        EpisodeError: the episode has no such camera.
    """
    short = name.removeprefix("observation.images.")
    if short in episode.cameras:
        return short
    if name and name not in episode.cameras:
        known = ", ".join(episode.cameras)
        raise EpisodeError(f"cameras: episode {episode.id} has no {name!r}; it has {known}", option="--camera")
    return name or next(iter(episode.cameras))


def _shots(detect: ShotDetector, camera: str, episode: Episode, inputs: Inputs) -> Records:
    frames = episode.cameras[camera_of(episode, camera)]
    if episode.meta.get("one_shot"):  # a clip of this project, which detection could only cut wrongly
        spans = [(0, len(frames))]
    else:
        spans = detect(frames)
    yield {"spans": np.array(spans, np.int64).reshape(-1, 2)}
    return {"shots": len(spans)}


def _motion(flow: FlowEstimator, camera: str, episode: Episode, inputs: Inputs) -> Records:
    motion = measure_motion(episode.cameras[camera_of(episode, camera)], episode.timestamps, flow)
    yield {"motion": motion.high, "mean": motion.mean}
    return {"motion": float(motion.high.mean())}


def _depth(estimate: DepthEstimator, camera: str, episode: Episode, inputs: Inputs) -> Records:
    camera = camera_of(episode, camera)
    if camera in episode.depth:  # measured depth is preferred to estimated depth
        return {"unit": "metres", "recorded": True}
    estimated = estimate(episode, camera)
    for first in range(0, len(estimated.maps), CHUNK):
        maps = estimated.maps.read(range(first, min(first + CHUNK, len(estimated.maps))))
        # Half precision has three decimal digits, more than the 766 levels that the depth colour map distinguishes.
        yield {"first": first, "depth": maps.astype(np.float16), "unit": estimated.unit}
    return {"unit": estimated.unit, "extent": list(estimated.extent)}


def _tracks(track: Tracker, camera: str, episode: Episode, inputs: Inputs) -> Records:
    camera = camera_of(episode, camera)
    frames = episode.cameras[camera]
    depth: Depths | None = None
    if camera in episode.depth:
        depth = FilledDepths(episode.depth[camera], 1.0, f"episode {episode.id}: depth of {camera}")
    elif "depth" in inputs and len(inputs["depth"]):
        depth = StoredDepths(inputs["depth"], episode)
    if "shots" in inputs:
        spans = inputs["shots"][0]["spans"].tolist()
    else:
        spans = [(0, len(frames))]
    points = 0
    for first, end in spans:
        shot = _Shot(frames, first, end)
        tracked = track(shot, None if depth is None else _Shot(depth, first, end))
        points += len(tracked.points)
        yield {"first": int(first), "points": tracked.points.astype(np.float16), "visible": tracked.visible}
    return {"points": points}


def _semantics(annotate: SemanticsAnnotator, camera: str, episode: Episode, inputs: Inputs) -> Records:
    if "motion" in inputs:
        motion = inputs["motion"][0]["motion"]
    else:
        motion = None
    semantics = annotate(episode, camera_of(episode, camera), motion)
    yield {
        "task": semantics.task,
        "scene": semantics.scene,
        "segments": [[int(p.start), int(p.end), p.text, p.skill] for p in semantics.parts if p.text],
        "key_frames": sorted({int(frame) for part in semantics.parts for frame in part.key_frames}),
        "by": [[part.text_by, part.key_by] for part in semantics.parts],
    }
    return {"parts": len(semantics.parts)}


_WORK: dict[str, Callable[[Any, str, Episode, Inputs], Records]] = {
    "shots": _shots,
    "motion": _motion,
    "depth": _depth,
    "tracks": _tracks,
    "semantics": _semantics,
}


@dataclass(frozen=True)
class _Shot:
    """The frames of a camera (pictures or depth maps) from ``first`` up to but not including ``end``."""

    whole: Any
    first: int
    end: int

    def __len__(self) -> int:
        return self.end - self.first

    def read(self, indices: Sequence[int]) -> np.ndarray:
        return self.whole.read([self.first + int(index) for index in indices])


@dataclass(frozen=True)
class Annotated:
    """An episode and its annotations; an annotation is None or empty if its step was left out."""

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
        """Reads the steps' records; texts are the data set's own if ``semantics`` was left out."""
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


class StoredDepths:
    """The maps of the depth step, as :class:`rsjax.tools.ingest.episode.Depths`.

    Args:
        records: the step's records, at least one.
        episode: the episode of the records.

    Attributes:
        unit: "metres" or "relative" (see :mod:`rsjax.tools.ingest.annotators.depth`).
    """

    def __init__(self, records: Source, episode: Episode) -> None:
        self._records = FrameRecords(records)
        self._episode = episode
        self.unit = str(records[0]["unit"])

    def __len__(self) -> int:
        return len(self._episode.timestamps)

    def read(self, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
        """Raises :class:`EpisodeError` where a frame has no map."""
        maps = []
        for frame in map(int, indices):
            record = self._records.with_frames(frame, frame)
            if record is None:
                raise EpisodeError(f"depth: no map of frame {frame} of episode {self._episode.id}; annotate it again")
            maps.append(record["depth"][frame - int(record["first"])].astype(np.float32))
        return np.stack(maps)


class FrameRecords:
    """Records of consecutive frames, of depth or tracks. The last record read is kept, since windows come in order."""

    def __init__(self, records: Source) -> None:
        self._records = records
        self._number = -1
        self._current = Record()

    def with_frames(self, first: int, last: int) -> Record | None:
        """Returns the record that contains these two frames and all between them; None if there is none."""
        begin = max(0, self._number)
        for number in [*range(begin, len(self._records)), *range(begin)]:
            if number != self._number:
                self._number = number
                self._current = self._records[number]
            record = self._current
            if "depth" in record:
                length = len(record["depth"])
            else:
                length = record["points"].shape[1]
            if record["first"] <= first and last < record["first"] + length:
                return record
        return None
