"""The interface of the five annotation steps: what their methods take and return, and the base class of all methods.

Axes: N frames of an episode, T frames of a part of it, H×W pixels, P points.
"""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from rsjax.config import require
from rsjax.errors import UserError
from rsjax.tools.ingest.episode import Depths, Episode, Frames, fingerprint

DepthUnit = Literal["metres", "relative"]
Pictures = UInt8[np.ndarray, "T H W 3"]
CHUNK = 32  # frames in memory at a time, unless a step needs more


class AnnotationError(UserError):
    """An annotator cannot run, either at all or on this episode. The message names what is missing and the cure."""


@dataclass(frozen=True)
class Annotator:
    """Base class of every method. Its fields are its parameters; whole numbers among them are checked.

    Instances can be pickled: a network is loaded at its first call, in the process that calls it.

    Attributes:
        name: the method's name, unique and a valid file name.
        version: to be raised when the same parameters give another output.
        least: least value of each whole-number field for which it is not 1.
    """

    name: ClassVar[str]
    version: ClassVar[int] = 1
    least: ClassVar[dict[str, int]] = {}

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            least = self.least.get(field.name, 1)
            message = f"{self.name}: {field.name} is {value}; it must be at least {least}"
            require(field.type is not int or value >= least, message)

    def load(self) -> Any:
        """Loads the network now instead of at the first call; methods without one do nothing.

        Raises:
            AnnotationError: the method cannot run here, because a package, a file or a device is missing.
        """

    def params(self) -> dict[str, Any]:
        """Returns all that the output depends on, JSON-ready: files by content and not by path; no device."""
        values: dict[str, Any] = {"name": self.name, "version": self.version}
        for field in (field for field in dataclasses.fields(self) if field.name != "device"):
            value = getattr(self, field.name)
            if isinstance(value, Path):
                files = [value]
                if value.is_dir():
                    files = sorted(file for file in value.rglob("*") if file.is_file())
                    files = [file for file in files if not {".git", "__pycache__"} & {*file.parts}]
                value = fingerprint(files)
            values[field.name] = value
        return values


@dataclass(frozen=True)
class Tracked:
    """Points followed through a part of an episode.

    Attributes:
        points: x (right) and y (down); 0 and 1 are the image's outer edges, as in :class:`rsjax.clip.Clip`. A point
            that is not visible keeps its last (or first) visible position, or the one that a network predicts.
        visible: each point is visible in at least one frame.
    """

    points: Float32[np.ndarray, "P T 2"]
    visible: Bool[np.ndarray, "P T"]


@dataclass(frozen=True)
class Motion:
    """Optical flow in pixels per second, scaled to a picture 256 pixels wide. Row t is from frame t-1; row 0 is 0.

    Attributes:
        mean: mean over all pixels.
        high: 95th percentile; a small moving object shows here, but hardly in the mean.
    """

    mean: Float32[np.ndarray, " N"]
    high: Float32[np.ndarray, " N"]


@dataclass(frozen=True)
class DepthMaps:
    """The depth of one camera's frames.

    Attributes:
        maps: > 0 along the optical axis; see ``unit``.
        unit: "metres", or "relative": 1 for the video's nearest point and ``depth.RELATIVE_FAR`` for its farthest,
            evenly spaced in 1/depth; correct up to an unknown scale and shift of 1/depth.
        extent: the video's least and greatest value in the network's own output (metres; 1/depth if relative).
    """

    maps: Depths
    unit: DepthUnit
    extent: tuple[float, float]


@dataclass(frozen=True)
class Semantic:
    """A description of one part of an episode.

    Attributes:
        start: first frame.
        end: the frame after the last.
        text: the action; "" if unknown.
        skill: one word for the kind of action, or "".
        key_frames: frames of the episode in which the action is decided, increasing; may be empty.
        text_by: origin of the text: "segment", "task", "" (none) or the network's name.
        key_by: origin of the key frames: "gripper", "motion", "" (none) or the network's name.
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
    """A description of a whole episode.

    Attributes:
        task: the task of the whole episode; "" if unknown.
        scene: description of the place; "" if unknown.
        parts: the episode's parts, in order.
    """

    task: str
    scene: str
    parts: tuple[Semantic, ...]


# What each step calls. Each raises AnnotationError if it cannot run, and EpisodeError for unreadable frames.

# "shots": returns the first frame of each shot and the one after its last, in order, covering all frames.
ShotDetector = Callable[[Frames], list[tuple[int, int]]]
# "motion": returns how far right and down each pixel of the first pictures has moved in the second ones, in pixels.
FlowEstimator = Callable[[Pictures, Pictures], Float32[np.ndarray, "T H W 2"]]
# "depth": takes an episode and a camera's name.
DepthEstimator = Callable[[Episode, str], DepthMaps]
# "tracks": follows points all over the frames of one shot, with new points where none is left; some need the depth.
Tracker = Callable[[Frames, Depths | None], Tracked]
# "semantics": takes an episode, the camera that a network sees, and its ``Motion.high``, if measured, for key frames.
SemanticsAnnotator = Callable[[Episode, str, Float[np.ndarray, " N"] | None], Semantics]


def in_chunks(frames: Frames, overlap: int = 0, size: int = CHUNK) -> Iterator[tuple[int, Pictures]]:
    """Yields all frames, a few at a time: the number of the first one, and the pictures.

    Args:
        overlap: pictures that each chunk shares with the previous one, < ``size``.
    """
    for start in range(0, max(len(frames) - overlap, 1), size - overlap):
        indices = range(start, min(start + size, len(frames)))
        if indices:
            yield start, frames.read(indices)
