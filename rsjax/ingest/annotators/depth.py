"""Stage "depth". Without weights: what the simulator or a depth camera recorded, and otherwise nothing.

Depth that networks estimate from pictures alone is mostly relative: 1/depth up to an unknown scale and shift. It is
stretched per video so that the nearest point is 1 and the farthest ``RELATIVE_FAR``, without a unit. The "inverse"
colour map over [1, RELATIVE_FAR] then has even steps in what the network said, and ``DepthMaps.extent`` undoes the
stretching.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Float32

from rsjax.ingest.annotators.protocols import CHUNK, ArrayDepths, DepthMaps
from rsjax.ingest.episode import Depths, Episode, EpisodeError

RELATIVE_FAR = 10.0
_NEAR_SHARE = 1 / RELATIVE_FAR  # of the nearest point's 1/depth, at the farthest


@dataclass(frozen=True)
class RecordedDepth:
    """The episode's own depth, in metres; None where the camera has none.

    Attributes:
        most_holes: greatest share of a frame that may be unmeasured; it is filled from the nearest measured pixel.
    """

    name: ClassVar[str] = "recorded"
    version: ClassVar[int] = 1
    most_holes: float = 0.5

    def __call__(self, episode: Episode, camera: str) -> DepthMaps | None:
        if camera not in episode.depth:
            return None
        maps = FilledDepths(episode.depth[camera], self.most_holes, f"episode {episode.id}: depth of {camera}")
        return DepthMaps(maps, "metres", _extent(maps))


@dataclass(frozen=True)
class FilledDepths:
    """Depth maps without holes, filled as they are read.

    Attributes:
        maps: as they were recorded, 0 (or not finite) where nothing was measured.
        most_holes: see :class:`RecordedDepth`.
        where: what messages call them.
    """

    maps: Depths
    most_holes: float
    where: str

    def __len__(self) -> int:
        return len(self.maps)

    def read(self, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
        """Raises :class:`EpisodeError` where too much of a frame was not measured."""
        maps = self.maps.read(indices)
        holes = ~(np.isfinite(maps) & (maps > 0))
        shares = holes.mean((1, 2))
        for index, share in zip(indices, shares, strict=True):
            if share > self.most_holes or share == 1:
                raise EpisodeError(
                    f"{self.where}, frame {index}: {share:.0%} of it was not measured, more than most_holes "
                    f"{self.most_holes:.0%}; raise that or leave the episode's depth out"
                )
        return np.stack([fill_holes(one, hole) if hole.any() else one for one, hole in zip(maps, holes, strict=True)])


def fill_holes(depth: Float32[np.ndarray, "H W"], holes: np.ndarray) -> Float32[np.ndarray, "H W"]:
    """Each hole (``holes`` is True) becomes what the nearest measured pixel holds, of which there is one at least."""
    _, nearest = cv2.distanceTransformWithLabels(
        holes.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    measured = ~holes
    by_label = np.zeros(int(nearest.max()) + 1, np.float32)
    by_label[nearest[measured]] = depth[measured]
    return np.where(holes, by_label[nearest], depth)


@dataclass(frozen=True)
class ConvertedDepths:
    """A network's maps, converted as they are read: the whole video is held once."""

    given: Float32[np.ndarray, "N H W"]
    convert: Callable[[Float32[np.ndarray, "n H W"]], Float32[np.ndarray, "n H W"]]

    def __len__(self) -> int:
        return len(self.given)

    def read(self, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
        return self.convert(self.given[np.asarray(indices, int)])


def relative_depth(inverse: Float32[np.ndarray, "N H W"]) -> DepthMaps:
    """A whole video's 1/depth, up to scale and shift, as :class:`DepthMaps` of unit "relative".

    Raises:
        ValueError: a value is not finite.
    """
    low, high = _extent(ArrayDepths(inverse))

    def stretch(part: Float32[np.ndarray, "n H W"]) -> Float32[np.ndarray, "n H W"]:
        position = (part - low) / (high - low) if high > low else np.zeros_like(part)
        return (1 / (_NEAR_SHARE + (1 - _NEAR_SHARE) * position)).astype(np.float32)

    return DepthMaps(ConvertedDepths(inverse, stretch), "relative", (low, high))


def inverse_of(maps: DepthMaps, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
    """The 1/depth that :func:`relative_depth` was given."""
    low, high = maps.extent
    position = (1 / maps.maps.read(indices) - _NEAR_SHARE) / (1 - _NEAR_SHARE)
    return (low + position * (high - low)).astype(np.float32)


def metric_depth(depth: Float32[np.ndarray, "N H W"]) -> DepthMaps:
    """A network's depth in metres as :class:`DepthMaps`; less than a millimetre, also behind the camera, becomes one.

    Raises:
        ValueError: a value is not finite.
    """
    low, high = _extent(ArrayDepths(depth))
    least = np.float32(1e-3)
    maps = ConvertedDepths(depth, lambda part: np.maximum(part, least))
    return DepthMaps(maps, "metres", (max(low, float(least)), max(high, float(least))))


def _extent(maps: Depths) -> tuple[float, float]:
    """Least and greatest value; :class:`ValueError` where one is not finite."""
    low, high = np.inf, -np.inf
    for start in range(0, len(maps), CHUNK):
        chunk = maps.read(range(start, min(start + CHUNK, len(maps))))
        if not np.isfinite(chunk).all():
            raise ValueError("depth is not finite everywhere")
        low, high = min(low, float(chunk.min())), max(high, float(chunk.max()))
    return low, high
