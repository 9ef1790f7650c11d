"""What the five stages take and give: the protocols that defaults and networks share, with units.

Every annotator is a frozen dataclass: its fields are its parameters, ``version`` is raised when the same parameters
give another output, and it can be sent to other processes, as networks are loaded by the first call.

Axes: N frames of an episode, T of some part of it, H×W pixels, P points.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from rsjax.config import require
from rsjax.errors import UserError
from rsjax.ingest.episode import Depths, Episode, Frames, fingerprint

DEPTH_UNITS = Literal["metres", "relative"]
CHUNK = 32  # frames in memory at a time, where a stage can do with few
_WHERE = ("device",)  # fields that say where something runs, not what comes out


class AnnotationError(UserError):
    """An annotator cannot run at all, or not on this episode. The message names what is missing and the cure."""


class Annotator(Protocol):
    """What all stages have in common.

    Attributes:
        name: of the method, a file name.
        version: of its output.
    """

    name: ClassVar[str]
    version: ClassVar[int]


@dataclass(frozen=True)
class Tracked:
    """Points followed through a part of an episode.

    Attributes:
        points: x (right) and y (down), 0 and 1 the image's outer edges, as in :class:`rsjax.clip.Clip`. Where a point
            is not visible, the place where it was last (or first) seen, or where a network believes it to be.
        visible: whether it was seen there. A point is seen in one frame at least.
    """

    points: Float32[np.ndarray, "P T 2"]
    visible: Bool[np.ndarray, "P T"]


class Tracker(Annotator, Protocol):
    """Stage "tracks"."""

    def __call__(self, frames: Frames, depth: Depths | None = None) -> Tracked:
        """Points all over the pictures; new ones are begun where none is left.

        Args:
            frames: of one shot.
            depth: the same frames' maps, for the trackers that need them.

        Raises:
            AnnotationError: it cannot run.
            EpisodeError: a frame cannot be read.
        """
        ...


class ShotDetector(Annotator, Protocol):
    """Stage "shots"."""

    def __call__(self, frames: Frames) -> list[tuple[int, int]]:
        """First frame of each shot and the one after its last, in order; together they are all frames."""
        ...


class FlowEstimator(Annotator, Protocol):
    """What stage "motion" measures with."""

    def __call__(
        self, before: UInt8[np.ndarray, "T H W 3"], after: UInt8[np.ndarray, "T H W 3"]
    ) -> Float32[np.ndarray, "T H W 2"]:
        """How far right and down each pixel of ``before`` is in ``after``, in pixels."""
        ...


@dataclass(frozen=True)
class Motion:
    """How much moves, in pixels per second of a picture that is 256 pixels wide. Row t is from frame t-1; row 0 is 0.

    Attributes:
        mean: over all pixels.
        high: that which 5 % of the pixels exceed: a small thing that moves shows here and hardly in the mean.
    """

    mean: Float32[np.ndarray, " N"]
    high: Float32[np.ndarray, " N"]


@dataclass(frozen=True)
class DepthMaps:
    """The depth of one camera's frames.

    Attributes:
        maps: > 0 along the optical axis; see ``unit``.
        unit: "metres", or "relative": 1 for the video's nearest point and ``depth.RELATIVE_FAR`` for its
            farthest, evenly spaced in 1/depth; true up to an unknown scale and shift of 1/depth.
        extent: the video's least and greatest value as the method gave it (metres; 1/depth where relative).
    """

    maps: Depths
    unit: DEPTH_UNITS
    extent: tuple[float, float]


class DepthEstimator(Annotator, Protocol):
    """Stage "depth"."""

    def __call__(self, episode: Episode, camera: str) -> DepthMaps | None:
        """One camera's depth; None where this method has none to give, and the clips stay without."""
        ...


@dataclass(frozen=True)
class Semantic:
    """What happens in one part of an episode.

    Attributes:
        start: its first frame.
        end: the frame after its last.
        text: what is done; "" where nothing says it.
        skill: the data set's word for it, or "".
        key_frames: frames of the episode in which it is decided, increasing; none where nothing points to one.
        text_by: "segment", "task", "" (nobody) or the network's name.
        key_by: "gripper", "motion", "" (nobody) or the network's name.
    """

    start: int
    end: int
    text: str
    skill: str
    key_frames: tuple[int, ...]
    text_by: str
    key_by: str


@dataclass(frozen=True)
class Semantics:
    """What an episode is about.

    Attributes:
        task: of the whole; "" where nobody says it.
        scene: where it plays; "" where nobody says it.
        parts: in order.
    """

    task: str
    scene: str
    parts: tuple[Semantic, ...]


class SemanticsAnnotator(Annotator, Protocol):
    """Stage "semantics"."""

    def __call__(self, episode: Episode, camera: str, motion: Float[np.ndarray, " N"] | None = None) -> Semantics:
        """What the episode is about.

        Args:
            camera: whose pictures a network looks at.
            motion: ``Motion.high`` of that camera, for key frames; None: not measured.
        """
        ...


@dataclass(frozen=True)
class ArrayFrames:
    """Pictures in memory, as :class:`rsjax.ingest.episode.Frames`."""

    pictures: UInt8[np.ndarray, "N H W 3"]

    def __len__(self) -> int:
        return len(self.pictures)

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        return self.pictures[np.asarray(indices, int)]


@dataclass(frozen=True)
class ArrayDepths:
    """Depth maps in memory, as :class:`rsjax.ingest.episode.Depths`."""

    maps: Float32[np.ndarray, "N H W"]

    def __len__(self) -> int:
        return len(self.maps)

    def read(self, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
        return self.maps[np.asarray(indices, int)]


def in_chunks(
    frames: Frames, overlap: int = 0, size: int = CHUNK
) -> Iterator[tuple[int, UInt8[np.ndarray, "n H W 3"]]]:
    """All frames, a few at a time: the first one's number and the pictures.

    Args:
        overlap: how many pictures each chunk shares with the one before, < ``size``.
    """
    for start in range(0, max(len(frames) - overlap, 1), size - overlap):
        indices = range(start, min(start + size, len(frames)))
        if indices:
            yield start, frames.read(indices)


def require_counts(annotator: Annotator, *names: str) -> None:
    """Asks of these fields to be at least 1; :class:`rsjax.config.ConfigError` says which one is not."""
    for name in names:
        value = getattr(annotator, name)
        require(value >= 1, f"{annotator.name}: {name} is {value}; it must be at least 1")


def prepare(annotator: Annotator) -> None:
    """Loads a network now instead of at its first call; the methods without one need nothing.

    Raises:
        AnnotationError: it cannot run here: a package, a file or a device is missing.
    """
    load = getattr(annotator, "load", None)
    if load is not None:
        load()


def parameters(annotator: Annotator) -> dict[str, Any]:
    """All that an annotator's output depends on, JSON-ready: files by what is in them, not by where they lie."""
    fields = {field.name: getattr(annotator, field.name) for field in dataclasses.fields(annotator)}  # type: ignore[arg-type]
    values = {name: _by_content(value) for name, value in fields.items() if name not in _WHERE}
    return {"name": annotator.name, "version": annotator.version} | values


def _by_content(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return parameters(value)  # type: ignore[arg-type]
    if not isinstance(value, Path):
        return value
    if not value.is_dir():
        return fingerprint([value])
    kept = (path for path in value.rglob("*") if path.is_file() and not {".git", "__pycache__"} & {*path.parts})
    return fingerprint(sorted(kept))
