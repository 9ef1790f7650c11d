"""The annotators as stages of a job: each writes what :mod:`rsjax.ingest.clips` reads.

Shots are found first; tracks are followed within each. Pictures are read in parts, so memory does not grow with the
length of an episode.
"""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import UInt8

from rsjax.data.codec import Record
from rsjax.ingest.annotators.depth import FilledDepths
from rsjax.ingest.annotators.motion import DISFlow, measure_motion
from rsjax.ingest.annotators.protocols import (
    CHUNK,
    Annotator,
    DepthEstimator,
    FlowEstimator,
    SemanticsAnnotator,
    ShotDetector,
    Tracker,
)
from rsjax.ingest.annotators.semantics import OwnSemantics
from rsjax.ingest.annotators.shots import HistogramShots
from rsjax.ingest.annotators.tracks import LucasKanade
from rsjax.ingest.clips import ClipConfig, ClipStage
from rsjax.ingest.episode import Depths, Episode, EpisodeError, Frames
from rsjax.ingest.jobs.work_items import Inputs, Stage, Summary, Work
from rsjax.ingest.stored import StoredDepths

Records = Generator[Record, None, Summary]


@dataclass(frozen=True)
class Annotators:
    """The method of each stage; None leaves the stage out."""

    shots: ShotDetector | None = field(default_factory=HistogramShots)
    motion: FlowEstimator | None = field(default_factory=DISFlow)
    depth: DepthEstimator | None = None  # a network; recorded depth needs no stage
    tracks: Tracker | None = field(default_factory=LucasKanade)
    semantics: SemanticsAnnotator | None = field(default_factory=OwnSemantics)


@dataclass(frozen=True)
class AnnotatorStage:
    """A stage that runs one annotator on one camera, of :class:`rsjax.ingest.jobs.work_items.Stage`.

    Attributes:
        annotator: what is run.
        write: (annotator, episode, camera, inputs) to records.
        camera: none: the episode's first.
    """

    name: str
    annotator: Annotator
    write: Callable[[Any, Episode, str, Inputs], Records]
    camera: str = ""
    needs: tuple[str, ...] = ()
    cpus: float = 1.0
    gpus: float = 0.0
    version: int = 1

    def params(self) -> dict[str, Any]:
        return {"camera": self.camera} | self.annotator.params()

    def open(self) -> Work:
        self.annotator.load()
        return self._work

    def _work(self, episode: Episode, inputs: Inputs) -> Records:
        camera = self.camera or next(iter(episode.cameras))
        if camera not in episode.cameras:
            there = ", ".join(episode.cameras)
            raise EpisodeError(f"cameras: episode {episode.id} has no {camera!r}; it has {there}", option="--camera")
        return (yield from self.write(self.annotator, episode, camera, inputs))


def make_stages(annotators: Annotators, config: ClipConfig, cpus: float = 1.0, gpus: float = 0.0) -> tuple[Stage, ...]:
    """The stages of a job, in order, the last of which makes the clips.

    Args:
        annotators: what is run.
        config: of the clips.
        cpus: of a worker of each stage, for a Ray cluster; fractions share a core.
        gpus: likewise, of a worker of those stages that have a network.
    """
    after: dict[str, tuple[str, ...]] = {"tracks": ("shots",), "semantics": ("motion",)}
    if _is_network(annotators.tracks):  # some look at depth
        after["tracks"] = ("shots", "depth")
    stages: list[AnnotatorStage] = []
    for name, write in _WRITERS.items():
        annotator = getattr(annotators, name)
        if annotator is not None:
            needs = tuple(need for need in after.get(name, ()) if getattr(annotators, need) is not None)
            share = gpus if _is_network(annotator) else 0.0
            stages.append(AnnotatorStage(name, annotator, write, config.camera, needs, cpus, share))
    return (*stages, ClipStage(config, tuple(stage.name for stage in stages), cpus=cpus))


def _is_network(annotator: object) -> bool:
    return hasattr(annotator, "device")


@dataclass(frozen=True)
class Part:
    """The frames from ``first`` to before ``end`` of a camera, pictures or depth maps, as if there were no others."""

    whole: Any
    first: int
    end: int

    def __len__(self) -> int:
        return self.end - self.first

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        return self.whole.read([self.first + int(index) for index in indices])


def _shots(detect: ShotDetector, episode: Episode, camera: str, inputs: Inputs) -> Records:
    spans = detect(episode.cameras[camera])
    yield {"spans": np.array(spans, np.int64).reshape(-1, 2)}
    return {"shots": len(spans)}


def _motion(flow: FlowEstimator, episode: Episode, camera: str, inputs: Inputs) -> Records:
    motion = measure_motion(episode.cameras[camera], episode.timestamps, flow)
    yield {"motion": motion.high, "mean": motion.mean}
    return {"motion": float(motion.high.mean())}


def _depth(estimate: DepthEstimator, episode: Episode, camera: str, inputs: Inputs) -> Records:
    if camera in episode.depth:  # what was measured counts before what would be estimated
        return {"unit": "metres", "recorded": True}
    found = estimate(episode, camera)
    for first in range(0, len(found.maps), CHUNK):
        maps = found.maps.read(range(first, min(first + CHUNK, len(found.maps))))
        # Half precision has three decimal digits, more than the 766 levels that the colour map keeps.
        yield {"first": first, "depth": maps.astype(np.float16), "unit": found.unit}
    return {"unit": found.unit, "extent": list(found.extent)}


def _tracks(track: Tracker, episode: Episode, camera: str, inputs: Inputs) -> Records:
    frames: Frames = episode.cameras[camera]
    depth: Depths | None = None
    if camera in episode.depth:
        depth = FilledDepths(episode.depth[camera], 1.0, f"episode {episode.id}: depth of {camera}")
    elif "depth" in inputs and len(inputs["depth"]):
        depth = StoredDepths(inputs["depth"], episode)
    spans = inputs["shots"][0]["spans"].tolist() if "shots" in inputs else [(0, len(frames))]
    points = 0
    for first, end in spans:
        tracked = track(Part(frames, first, end), None if depth is None else Part(depth, first, end))
        points += len(tracked.points)
        yield {"first": int(first), "points": tracked.points.astype(np.float16), "visible": tracked.visible}
    return {"points": points}


def _semantics(annotate: SemanticsAnnotator, episode: Episode, camera: str, inputs: Inputs) -> Records:
    found = annotate(episode, camera, inputs["motion"][0]["motion"] if "motion" in inputs else None)
    yield {
        "task": found.task,
        "scene": found.scene,
        "segments": [[int(p.start), int(p.end), p.text, p.skill] for p in found.parts if p.text],
        "key_frames": sorted({int(frame) for part in found.parts for frame in part.key_frames}),
        "by": [[part.text_by, part.key_by] for part in found.parts],
    }
    return {"parts": len(found.parts)}


_WRITERS: dict[str, Callable[[Any, Episode, str, Inputs], Records]] = {
    "shots": _shots,
    "motion": _motion,
    "depth": _depth,
    "tracks": _tracks,
    "semantics": _semantics,
}
