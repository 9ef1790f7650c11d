"""Clips and videos: each array's shape, dtype, unit and range.

Axes: T frames, H×W pixels, A action dimensions, N₀ tracks, B clips.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8

Array = Any  # JAX or numpy
UNKNOWN = "unknown"  # the task or label of a clip whose data set does not name it


def words_of(value: object) -> str:
    """Returns a data set's text without surrounding blanks; "" for null, which some data sets write as NaN."""
    return "" if value is None or value != value else str(value).strip()


@dataclass(frozen=True)
class Clip:
    """One clip of one episode, as numpy arrays.

    Attributes:
        rgb: frames, 0–255, RGB order, upright (row 0 is the top).
        depth: distance along the camera's optical axis in metres (z-depth, not ray length), > 0, or 0 in the bars of
            a padded picture; None if none was recorded or estimated.
        actions: row t led from frame t-1 into frame t; row 0 is zeros (nothing led into the first frame).
        tracks: x (right) and y (down) of each keypoint in each frame; 0 and 1 are the image's outer edges, so the
            centre of pixel column i is (i + 0.5) / W. May leave [0, 1] when the point leaves the image.
        visible: whether the point is inside the image and not occluded. True in frame 0.
        success: the simulator's success predicate at each frame.
        task: the robot's task, in words; ``unknown`` if the data set does not say.
        provenance: the clip's origin (source, seed, episode, camera, expert's settings …), JSON-ready.
    """

    rgb: UInt8[np.ndarray, "T H W 3"]
    depth: Float32[np.ndarray, "T H W"] | None
    actions: Float32[np.ndarray, "T A"]
    tracks: Float32[np.ndarray, "N0 T 2"]
    visible: Bool[np.ndarray, "N0 T"]
    success: Bool[np.ndarray, " T"]
    task: str
    provenance: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Video:
    """Frames of B clips as numpy arrays: the input and output of world models.

    Attributes:
        rgb: frames, 0–255, RGB order, upright.
        depth: z-depth in metres; all NaN for a clip without depth. None: no clip has depth.
        tasks: the robot's task in each clip, in words; None: unknown.
        state: a column for each of :data:`rsjax.data.state_labels.STATE`, NaN where unknown: of recorded clips the
            labels, of generated ones what the model's state heads read, with the probability of success. None: neither.
    """

    rgb: UInt8[np.ndarray, "B T H W 3"]
    depth: Float32[np.ndarray, "B T H W"] | None = None
    tasks: Shaped[np.ndarray, " B"] | None = None
    state: Float32[np.ndarray, "B T 3"] | None = None

    @property
    def has_depth(self) -> Bool[np.ndarray, " B"]:
        """Which clips have depth."""
        if self.depth is None:
            return np.zeros(len(self.rgb), bool)
        return ~np.isnan(self.depth[:, :1]).any(axis=(1, 2, 3))

    def __len__(self) -> int:
        """Returns the number of clips."""
        return len(self.rgb)

    def __getitem__(self, rows: Any) -> "Video":
        """Returns some of the clips: ``rows`` is an array of numbers, a mask or a slice."""
        parts = (None if x is None else x[rows] for x in (self.depth, self.tasks, self.state))
        return Video(self.rgb[rows], *parts)

    def frames(self, first: int, last: int | None = None) -> "Video":
        """Returns frames ``first`` to ``last`` - 1 of every clip."""
        depth, state = (None if x is None else x[:, first:last] for x in (self.depth, self.state))
        return Video(self.rgb[:, first:last], depth, self.tasks, state)
