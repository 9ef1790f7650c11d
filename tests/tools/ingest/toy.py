"""Episodes made up on the spot, some of them broken, steps that count how often they run, and ingests of both."""

import os
import signal
import time
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from rsjax.config import content_key
from rsjax.tools.ingest.annotate import Annotators, annotation_steps
from rsjax.tools.ingest.annotators.categories import CategoryConfig
from rsjax.tools.ingest.annotators.protocols import AnnotationError, Annotator, DepthMaps, Tracked
from rsjax.tools.ingest.clips import ClipConfig, clip_step
from rsjax.tools.ingest.episode import Depths, Episode, EpisodeError, EpisodeRef, Frames, Segment
from rsjax.tools.ingest.ingest import ingest
from rsjax.tools.ingest.summary import IngestSummary
from rsjax.tools.ingest.windows import WindowConfig
from rsjax.tools.ingest.work_items import IngestPlan, Inputs, Records, SplitShares, Step
from tests.tools.ingest.videos import ArrayFrames

FPS = 10.0
CONFIG = ClipConfig(
    WindowConfig(frames=4, rate=2), image_size=8, tracks=6, categories=CategoryConfig((("pick*", "simple"),))
)
NOTHING = Annotators(shots=None, motion=None, tracks=None, semantics=None)


@dataclass(frozen=True)
class Pictures:
    """Every pixel of picture t is t (its green value), and 100 (its red one)."""

    count: int
    height: int = 12
    width: int = 16

    def __len__(self) -> int:
        return self.count

    def read(self, indices: Sequence[int]) -> np.ndarray:
        frames = np.full((len(indices), self.height, self.width, 3), 100, np.uint8)
        frames[..., 1] = np.asarray(indices)[:, None, None]
        return frames


@dataclass(frozen=True)
class Maps(Pictures):
    """Depth of frame t is 1 + t / 10 metres."""

    def read(self, indices: Sequence[int]) -> np.ndarray:
        near = 1 + np.asarray(indices, np.float32)[:, None, None] / 10
        return np.broadcast_to(near, (len(indices), self.height, self.width)).copy()


def episode(name: str, count: int = 40, depth: bool = False, **fields: Any) -> Episode:
    """Actions of row t are t and -t."""
    steps = np.arange(count, dtype=np.float32)
    made: dict[str, Any] = {
        "id": name,
        "fingerprint": f"{abs(hash(name)) % 16**16:016x}",
        "task": "pick a cup",
        "fps": FPS,
        "timestamps": np.arange(count) / FPS,
        "actions": np.stack([steps, -steps], 1),
        "states": None,
        "cameras": {"front": Pictures(count)},
        "depth": {"front": Maps(count)} if depth else {},
        "segments": (Segment(0, count // 2, "reach"), Segment(count // 2, count, "grasp", "Grasp")),
        "meta": {"scene": "kitchen"},
    }
    return Episode(**made | fields)


@dataclass
class Source:
    """``count`` episodes of 40 frames; ``broken`` ones are unreadable, ``short`` ones have 5, ``deep`` ones depth."""

    count: int
    broken: tuple[int, ...] = ()
    short: tuple[int, ...] = ()
    deep: Container[int] = ()
    version: str = "0"
    name: str = "toy"

    def episodes(self) -> Iterator[EpisodeRef]:
        for number in range(self.count):
            yield EpisodeRef(f"episode_{number:03d}", f"{number:015x}{self.version}", {"number": number})

    def read(self, ref: EpisodeRef) -> Episode:
        number = ref.location["number"]
        if number in self.broken:
            raise EpisodeError(f"video_{number}.mp4: truncated; copy it again")
        frames = 5 if number in self.short else 40
        return episode(ref.id, frames, number in self.deep, fingerprint=ref.fingerprint)


@dataclass(frozen=True)
class Noting:
    """The work of a step with two records. It leaves a line in a log for each run, and may die or fail.

    Attributes:
        log: a file; a line is the step's name and the episode's. Process ids are names of files in pids/ beside it.
        needs: the steps whose output it reads.
        deadly: an episode that kills its worker each time.
        once: likewise, but the first time only.
        fails: an episode that raises.
        seconds: how long each run takes.
    """

    log: str
    name: str
    needs: tuple[str, ...] = ()
    deadly: str = ""
    once: str = ""
    fails: str = ""
    seconds: float = 0.0

    def __call__(self, episode: Episode, inputs: Inputs) -> Records:
        line = f"{self.name} {episode.id}"
        first = not Path(self.log).exists() or line not in Path(self.log).read_text().splitlines()
        with Path(self.log).open("a") as file:
            file.write(f"{line}\n")
        (Path(self.log).parent / "pids").mkdir(exist_ok=True)
        (Path(self.log).parent / "pids" / str(os.getpid())).touch()
        time.sleep(self.seconds)
        yield {"i": np.array(0), "from": [len(inputs[name]) for name in self.needs]}
        if episode.id == self.deadly or (episode.id == self.once and first):
            os.kill(os.getpid(), signal.SIGKILL)
        if episode.id == self.fails:
            raise ValueError("no such colour")
        yield {"i": np.array(1)}
        return {"windows": {"kept": 2}, "left_out": {}}


def noting_plan(folder: Path, source: Source, extra: int = 0, seconds: float = 0.0, **fields: Any) -> IngestPlan:
    """Returns a plan of two :class:`Noting` steps, ``first`` with these fields and ``clips`` after it.

    Args:
        extra: a parameter of both steps.
        seconds: how long each takes.
    """
    log = str(folder / "log")
    work = Noting(log, "first", seconds=seconds, **fields), Noting(log, "clips", ("first",), seconds=seconds)
    steps = tuple(Step(each.name, each, content_key({"extra": extra}), each.needs) for each in work)
    return IngestPlan(source, steps, folder / "store")


def runs(folder: Path) -> list[str]:
    """The lines of the log."""
    return (folder / "log").read_text().splitlines() if (folder / "log").exists() else []


@dataclass(frozen=True)
class Relative(Annotator):
    """A depth network that returns 3 everywhere, without a unit; unless ``loads``, it cannot be loaded."""

    name: ClassVar[str] = "relative"
    loads: bool = True
    device: str = "cpu"

    def __call__(self, episode: Episode, camera: str) -> DepthMaps:
        frames = len(episode.timestamps)
        return DepthMaps(ArrayFrames(np.full((frames, 12, 16), 3, np.float32)), "relative", (0.0, 1.0))

    def load(self) -> None:
        if not self.loads:
            raise AnnotationError("relative.pt: no such file")


@dataclass(frozen=True)
class ByDepth(Annotator):
    """A tracking network of one point, whose x is the depth of each frame / 10."""

    name: ClassVar[str] = "by-depth"
    device: str = "cpu"

    def __call__(self, frames: Frames, depth: Depths | None = None) -> Tracked:
        if depth is None:
            raise AnnotationError("no depth to track by")
        x = depth.read(range(len(frames)))[:, 0, 0] / 10
        return Tracked(np.stack([x, x], 1)[None].astype(np.float32), np.ones((1, len(frames)), bool))


def clip_plan(
    folder: Path, source: Source, annotators: Annotators = NOTHING, share: float = 0.25, config: ClipConfig = CONFIG
) -> IngestPlan:
    """Returns the plan of a store of clips in ``folder``."""
    steps = annotation_steps(annotators, config.camera)
    steps = (*steps, clip_step(config, tuple(step.name for step in steps)))
    return IngestPlan(source, steps, folder / "store", SplitShares(share), meta={"config": {}})


def ingested(plan: IngestPlan, keep_clips: bool = False, retry: bool = False) -> IngestSummary | None:
    """Ingests in this process; the numbers of the summary add up."""
    summary = ingest(plan, keep_clips=keep_clips, retry=retry)
    if summary is not None:
        assert summary.episodes == summary.done + len(summary.filtered) + len(summary.quarantined)
    return summary
