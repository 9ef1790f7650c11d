"""Episodes made up on the spot, some of them broken, and stages that count how often they run."""

import os
import signal
import time
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from rsjax.data.codec import Record
from rsjax.ingest.annotators.protocols import AnnotationError, Annotator, DepthMaps, Tracked
from rsjax.ingest.episode import Depths, Episode, EpisodeError, EpisodeRef, Frames, Segment
from rsjax.ingest.jobs.work_items import Inputs, Job, Summary, Work
from tests.ingest.videos import ArrayDepths

FPS = 10.0


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
    """``count`` episodes of 40 frames; those in ``broken`` cannot be read, those in ``short`` have 5 frames.

    Attributes:
        deep: how many of them, from the first on, have depth even if ``depth`` is False.
        only: one more that has.
    """

    count: int
    broken: tuple[int, ...] = ()
    short: tuple[int, ...] = ()
    depth: bool = False
    deep: int = 0
    only: int = -1
    version: str = "0"
    name: str = "toy"

    def episodes(self) -> Iterator[EpisodeRef]:
        for number in range(self.count):
            yield EpisodeRef(f"episode_{number:03d}", f"{number:015x}{self.version}", {"number": number})

    def read(self, ref: EpisodeRef) -> Episode:
        number = ref.location["number"]
        if number in self.broken:
            raise EpisodeError(f"video_{number}.mp4: truncated; copy it again")
        frames, deep = 5 if number in self.short else 40, self.depth or number < self.deep or number == self.only
        return episode(ref.id, frames, deep, fingerprint=ref.fingerprint)


@dataclass(frozen=True)
class Noting:
    """A stage of two records that leaves a line in a log for each run, and may die, fail or wait.

    Attributes:
        log: a file; a line is a stage's name and an episode's.
        kills: a file; while it is not there, the episode ``fatal`` creates it and kills its worker. "": it always dies.
        fails: an episode that raises.
        seconds: for which each run takes.
    """

    log: str
    name: str = "first"
    version: int = 1
    needs: tuple[str, ...] = ()
    cpus: float = 1.0
    gpus: float = 0.0
    extra: int = 0
    fatal: str = ""
    kills: str = ""
    fails: str = ""
    seconds: float = 0.0

    def params(self) -> dict[str, Any]:
        return {"extra": self.extra}

    def open(self) -> Work:
        return self._work

    def _work(self, episode: Episode, inputs: Inputs) -> Generator[Record, None, Summary]:
        with Path(self.log).open("a") as file:
            file.write(f"{self.name} {episode.id}\n")
        time.sleep(self.seconds)
        yield {"i": np.array(0), "from": [len(inputs[name]) for name in self.needs]}
        if episode.id == self.fatal and not (self.kills and Path(self.kills).exists()):
            if self.kills:
                Path(self.kills).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if episode.id == self.fails:
            raise ValueError("no such colour")
        yield {"i": np.array(1)}
        return {"windows": {"kept": 2}}


def job(folder: Path, source: Source, **fields: Any) -> Job:
    """Two :class:`Noting` stages, whose fields are those given; ``log`` lies in the folder."""
    log = str(folder / "log")
    first = Noting(log, "first", **fields)
    return Job(source, "", (first, Noting(log, "second", needs=("first",), seconds=first.seconds)), folder)


def runs(folder: Path) -> list[str]:
    """The lines of the log."""
    return (folder / "log").read_text().splitlines() if (folder / "log").exists() else []


@dataclass(frozen=True)
class Relative(Annotator):
    """A depth network that says 3 of everything, without a unit; where ``there`` is False it cannot be loaded."""

    name: ClassVar[str] = "relative"
    there: bool = True
    device: str = "cpu"

    def __call__(self, episode: Episode, camera: str) -> DepthMaps:
        frames = len(episode.timestamps)
        return DepthMaps(ArrayDepths(np.full((frames, 12, 16), 3, np.float32)), "relative", (0.0, 1.0))

    def load(self) -> None:
        if not self.there:
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
