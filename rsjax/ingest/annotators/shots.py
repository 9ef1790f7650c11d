"""Stage "shots": where a video was cut. Without weights: a jump of the colour histogram.

Finds hard cuts alone. A teleoperated episode has none, so one that is found is worth a look.
"""

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.ingest.annotators.protocols import in_chunks, require_counts
from rsjax.ingest.episode import Frames

_BINS = (16, 4, 4)  # hue, saturation, value
_SIDE = 96  # pixels of the longer side that histograms are made of


@dataclass(frozen=True)
class HistogramShots:
    """A cut is where the HSV histogram changes by more than ``threshold``, and much more than around it.

    Attributes:
        threshold: share of the pixels that change their bin, 0–1.
        prominence: how many times the greatest change of the ``around`` steps on either side it has to be.
        around: steps.
        shortest: frames; a cut nearer than this to the one before is left out (a flash makes two).
    """

    name: ClassVar[str] = "hsv-histogram"
    version: ClassVar[int] = 1
    threshold: float = 0.4
    prominence: float = 2.0
    around: int = 3
    shortest: int = 8

    def __post_init__(self) -> None:
        require_counts(self, "around", "shortest")

    def __call__(self, frames: Frames) -> list[tuple[int, int]]:
        changes = histogram_changes(frames)
        cuts: list[int] = []
        for t in np.flatnonzero(changes > self.threshold).tolist():
            beside = np.concatenate([changes[max(1, t - self.around) : t], changes[t + 1 : t + 1 + self.around]])
            sharp = changes[t] >= self.prominence * beside.max(initial=0.0)
            if sharp and t - (cuts[-1] if cuts else 0) >= self.shortest:
                cuts.append(t)
        return spans_between(cuts, len(frames))


def spans_between(cuts: list[int], count: int) -> list[tuple[int, int]]:
    """The shots that begin at frame 0 and at each of the cuts (increasing, between 1 and ``count`` - 1)."""
    return list(zip([0, *cuts], [*cuts, count], strict=True))


def histogram_changes(frames: Frames) -> Float32[np.ndarray, " N"]:
    """Half the L1 distance of each frame's HSV histogram from the one before, 0–1; 0 for the first."""
    changes, last = np.zeros(len(frames), np.float32), None
    for start, pictures in in_chunks(frames):
        for t, picture in enumerate(pictures, start):
            histogram = _histogram(picture)
            changes[t] = 0.0 if last is None else np.abs(histogram - last).sum() / 2
            last = histogram
    return changes


def _histogram(picture: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, " bins"]:
    scale = min(1.0, _SIDE / max(picture.shape[:2]))
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else picture
    hsv = cv2.cvtColor(small, cv2.COLOR_RGB2HSV)
    histogram = cv2.calcHist([hsv], [0, 1, 2], None, list(_BINS), [0, 180, 0, 256, 0, 256])
    return histogram.ravel() / histogram.sum()
