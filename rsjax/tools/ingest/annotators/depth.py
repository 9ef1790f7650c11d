"""Step "depth": fills the holes of recorded depth, and converts the depth that networks estimate.

Depth that a network estimates from pictures is mostly relative: 1/depth up to an unknown scale and shift. It is
stretched for each video so that the nearest point is 1 and the farthest is ``RELATIVE_FAR``, without a unit. The
"inverse" colour map over [1, RELATIVE_FAR] then has even steps in the network's output, and ``DepthMaps.extent`` makes
it possible to undo the stretching.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from rsjax.tools.ingest.annotators.protocols import CHUNK, DepthMaps
from rsjax.tools.ingest.episode import Depths, EpisodeError

RELATIVE_FAR = 10.0
_NEAR_SHARE = 1 / RELATIVE_FAR  # 1/depth of the farthest point, relative to the nearest


@dataclass(frozen=True)
class RecordedDepth:
    """Settings for an episode's recorded depth, in metres. It needs no step: clips read it when they are cut.

    Attributes:
        most_holes: largest share of a frame that may be unmeasured.
    """

    name: ClassVar[str] = "recorded"
    most_holes: float = 0.5


@dataclass(frozen=True)
class FilledDepths:
    """Recorded depth maps whose holes are filled from the nearest measured pixel when they are read.

    Attributes:
        maps: as recorded; 0 or not finite where nothing was measured.
        most_holes: see :class:`RecordedDepth`.
        where: the maps' name in error messages.
    """

    maps: Depths
    most_holes: float
    where: str

    def __len__(self) -> int:
        return len(self.maps)

    def read(self, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
        """Reads these maps; raises :class:`EpisodeError` if too much of a frame is unmeasured."""
        maps = self.maps.read(indices)
        holes = ~(np.isfinite(maps) & (maps > 0))
        for index, share in zip(indices, holes.mean((1, 2)), strict=True):
            if share > self.most_holes or share == 1:
                raise EpisodeError(
                    f"{self.where}, frame {index}: {share:.0%} of it was not measured, more than most_holes "
                    f"{self.most_holes:.0%}; raise that or leave the episode's depth out"
                )
        return np.stack([fill_holes(one, hole) if hole.any() else one for one, hole in zip(maps, holes, strict=True)])


def fill_holes(depth: Float32[np.ndarray, "H W"], holes: Bool[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Fills each hole (``holes`` is True) from the nearest measured pixel; at least one must be measured."""
    _, nearest = cv2.distanceTransformWithLabels(
        holes.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    measured = ~holes
    by_label = np.zeros(int(nearest.max()) + 1, np.float32)
    by_label[nearest[measured]] = depth[measured]
    return np.where(holes, by_label[nearest], depth)


@dataclass(frozen=True)
class ConvertedDepths:
    """A network's maps, converted when they are read, so that memory holds the video only once."""

    maps: Float32[np.ndarray, "N H W"]
    convert: Callable[[Float32[np.ndarray, "n H W"]], Float32[np.ndarray, "n H W"]]

    def __len__(self) -> int:
        return len(self.maps)

    def read(self, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
        return self.convert(self.maps[np.asarray(indices, int)])


def relative_depth(inverse: Float32[np.ndarray, "N H W"]) -> DepthMaps:
    """Stretches a whole video's 1/depth, known up to scale and shift, to :class:`DepthMaps` in the unit "relative".

    Raises:
        ValueError: a value is not finite.
    """
    extent = _extent(inverse)
    return DepthMaps(ConvertedDepths(inverse, lambda part: stretch(part, extent)), "relative", extent)


def stretch(inverse: Float32[np.ndarray, "n H W"], extent: tuple[float, float]) -> Float32[np.ndarray, "n H W"]:
    """Returns the relative depth of a network's 1/depth: 1 at the greatest value of ``extent``, ``RELATIVE_FAR`` at its
    least, and even in 1/depth beyond them, up to 1000.
    """
    low, high = extent
    position = (inverse - low) / (high - low) if high > low else np.zeros_like(inverse)
    return (1 / np.maximum(_NEAR_SHARE + (1 - _NEAR_SHARE) * position, 1e-3)).astype(np.float32)


def inverse_of(maps: DepthMaps, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
    """Undoes :func:`relative_depth`: returns the network's 1/depth."""
    low, high = maps.extent
    position = (1 / maps.maps.read(indices) - _NEAR_SHARE) / (1 - _NEAR_SHARE)
    return (low + position * (high - low)).astype(np.float32)


def metric_depth(depth: Float32[np.ndarray, "N H W"]) -> DepthMaps:
    """Wraps a network's depth in metres; values below a millimetre, even negative ones, become a millimetre.

    Raises:
        ValueError: a value is not finite.
    """
    low, high = _extent(depth)
    least = np.float32(1e-3)
    maps = ConvertedDepths(depth, lambda part: np.maximum(part, least))
    return DepthMaps(maps, "metres", (max(low, float(least)), max(high, float(least))))


def _extent(maps: Float32[np.ndarray, "N H W"]) -> tuple[float, float]:
    """Returns the least and the greatest value; raises :class:`ValueError` if one is not finite."""
    low, high = np.inf, -np.inf
    for start in range(0, len(maps), CHUNK):
        chunk = maps[start : start + CHUNK]
        if not np.isfinite(chunk).all():
            raise ValueError("depth is not finite everywhere")
        low, high = min(low, float(chunk.min())), max(high, float(chunk.max()))
    return low, high
