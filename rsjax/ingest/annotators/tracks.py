"""Stage "tracks": points followed through a shot. Without weights: pyramidal Lucas–Kanade.

Any method that follows given points through a few pictures (:class:`Follower`) becomes a tracker by
:func:`track_in_spans`: points begin on a grid, those that are seen at a span's end go on, and cells of the grid that
lost theirs get new ones.

Axes: P points, T frames, H×W pixels.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from rsjax.config import require
from rsjax.ingest.annotators.protocols import Tracked, require_counts
from rsjax.ingest.episode import Depths, Frames

Followed = tuple[Float32[np.ndarray, "P T 2"], Bool[np.ndarray, "P T"]]


class Follower(Protocol):
    """Follows points of the first picture, x and y with 0 and 1 the image's outer edges, through the others."""

    def __call__(
        self,
        pictures: UInt8[np.ndarray, "T H W 3"],
        points: Float32[np.ndarray, "P 2"],
        depth: Float32[np.ndarray, "T H W"] | None,
    ) -> Followed: ...


@dataclass(frozen=True)
class LucasKanade:
    """Pyramidal Lucas–Kanade from picture to picture; a point that does not come back on the way back is lost.

    Where a patch stays as it is, so does its point, even on a surface without texture: a camera that moves over such a
    surface is not seen to. A lost point is found again only where it was lost, when its patch is there again.

    Attributes:
        grid: points begin in the middles of grid × grid cells.
        span: new points are begun every so many frames.
        window: side of the patch that is matched, in pixels.
        levels: of the pyramid, beyond the picture itself.
        tolerance: how far from its start a point may end that is followed there and back, in pixels.
        likeness: least correlation of a point's patch with that of the picture before; less is another surface.
        still: grey levels (of 255) by which no pixel of a patch may change that counts as staying as it is.
    """

    name: ClassVar[str] = "lucas-kanade"
    version: ClassVar[int] = 1
    grid: int = 16
    span: int = 16
    window: int = 9
    levels: int = 3
    tolerance: float = 0.5
    likeness: float = 0.8
    still: float = 8.0

    def __post_init__(self) -> None:
        require_counts(self, "grid", "span")
        require(self.window >= 3, f"lucas-kanade: window is {self.window}; it must be at least 3")
        require(self.levels >= 0, f"lucas-kanade: levels is {self.levels}; it must be at least 0")

    def __call__(self, frames: Frames, depth: Depths | None = None) -> Tracked:
        return track_in_spans(frames, self.follow, self.grid, self.span)

    def follow(
        self,
        pictures: UInt8[np.ndarray, "T H W 3"],
        points: Float32[np.ndarray, "P 2"],
        depth: Float32[np.ndarray, "T H W"] | None = None,
    ) -> Followed:
        """As :class:`Follower`; depth is not used."""
        grey = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures]
        size = np.array(pictures.shape[2:0:-1], np.float32)
        place = points.astype(np.float32) * size - 0.5
        seen, patch = np.ones(len(points), bool), _patches(grey[0], place, self.window)
        places, visible = [place], [seen]
        for before, after in itertools.pairwise(grey):
            stays = np.abs(_patches(after, place, self.window) - patch).max(1, initial=0.0) <= self.still
            going = np.flatnonzero(seen & ~stays)
            place, seen = place.copy(), stays
            place[going], seen[going] = self._step(before, after, place[going])
            now = _patches(after, place, self.window)
            patch = np.where(seen[:, None], now, patch)
            places.append(place)
            visible.append(seen)
        return ((np.stack(places, 1) + 0.5) / size).astype(np.float32), np.stack(visible, 1)

    def _step(self, before: np.ndarray, after: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points of one picture are in the next, and which were found; the others stay where they are."""
        if not len(start):
            return start, np.zeros(0, bool)
        options: Any = {"winSize": (self.window, self.window), "maxLevel": self.levels}
        lucas_kanade: Any = cv2.calcOpticalFlowPyrLK  # its stub knows no None
        there, found, _ = lucas_kanade(before, after, start, None, **options)
        back, found_back, _ = lucas_kanade(after, before, there, None, **options)
        came_back = np.linalg.norm(back - start, axis=-1) <= self.tolerance
        inside = ((there >= -0.5) & (there < np.array(after.shape[::-1]) - 0.5)).all(-1)
        kept = (found[:, 0] == 1) & (found_back[:, 0] == 1) & came_back & inside
        kept[kept] = _likeness(before, after, start[kept], there[kept], self.window) >= self.likeness
        return np.where(kept[:, None], there, start), kept


def _likeness(before: np.ndarray, after: np.ndarray, start: np.ndarray, there: np.ndarray, side: int) -> np.ndarray:
    """Correlation of the patches around two sets of points; 1 where both are even."""
    left, right = _patches(before, start, side), _patches(after, there, side)
    left, right = left - left.mean(1, keepdims=True), right - right.mean(1, keepdims=True)
    even = np.float32(side * side)  # a variance of one grey level is noise
    scale = np.sqrt((left**2).sum(1) * (right**2).sum(1))
    return ((left * right).sum(1) + even) / (scale + even)


def _patches(picture: np.ndarray, points: np.ndarray, side: int) -> np.ndarray:
    ticks = np.arange(side, dtype=np.float32) - (side - 1) / 2
    x = points[:, 0, None, None] + ticks[None, None, :] + 0 * ticks[None, :, None]
    y = points[:, 1, None, None] + ticks[None, :, None] + 0 * ticks[None, None, :]
    flat = (len(points), side * side)
    if not len(points):
        return np.zeros(flat, np.float32)
    maps = x.reshape(flat).astype(np.float32), y.reshape(flat).astype(np.float32)
    return cv2.remap(picture.astype(np.float32), *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def track_in_spans(frames: Frames, follow: Follower, grid: int, span: int, depth: Depths | None = None) -> Tracked:
    """Follows points through all frames, ``span`` steps at a time.

    Args:
        frames: at least one.
        follow: the method.
        grid: one point at least in each of grid × grid cells at the start of each span.
        span: steps from the first picture of a span to its last, which is the next span's first.
        depth: handed on to the method.
    """
    count = len(frames)
    points, visible = np.zeros((0, count, 2), np.float32), np.zeros((0, count), bool)
    for start in range(0, max(count - 1, 1), span):
        end = min(start + span + 1, count)
        seeds = grid_points(grid, points[visible[:, start], start])
        points = np.concatenate([points, np.repeat(seeds[:, None], count, 1)])
        visible = np.concatenate([visible, np.zeros((len(seeds), count), bool)])
        visible[len(visible) - len(seeds) :, start] = True
        going = np.flatnonzero(visible[:, start])
        maps = depth.read(range(start, end)) if depth else None
        places, seen = follow(frames.read(range(start, end)), points[going, start], maps)
        points[going, start:end] = places
        points[going, end:] = places[:, -1:]
        visible[going, start + 1 : end] = seen[:, 1:]
    return Tracked(points, visible)


def grid_points(grid: int, taken: Float[np.ndarray, "Q 2"]) -> Float32[np.ndarray, "P 2"]:
    """The middles of those of grid × grid cells that hold none of the points ``taken``."""
    ticks = (np.arange(grid, dtype=np.float32) + 0.5) / grid
    middles = np.stack(np.meshgrid(ticks, ticks), -1)  # row, column, (x, y)
    column, row = np.clip((taken * grid).astype(int), 0, grid - 1).T
    free = np.ones((grid, grid), bool)
    free[row, column] = False
    return middles[free]


def window_tracks(tracked: Tracked, frames: Int[np.ndarray, " T"] | Sequence[int], count: int) -> Tracked:
    """The tracks of a window of these frames, as many as a clip holds, as :class:`rsjax.clip.Clip` wants them.

    Only points that are seen in the window's first frame count. Of more than ``count``, half are those that move most
    and the others are spread evenly over the rest; where there are fewer, they are repeated.

    Raises:
        ValueError: no point is seen in the first frame, which a :class:`Tracker` on one shot never leaves so.
    """
    frames = np.asarray(frames)
    there = np.flatnonzero(tracked.visible[:, frames[0]])
    if not len(there):
        raise ValueError(f"no point is seen in frame {frames[0]}")
    points, visible = tracked.points[there][:, frames], tracked.visible[there][:, frames]
    steps = np.linalg.norm(np.diff(points, axis=1), axis=-1) * (visible[:, 1:] & visible[:, :-1])
    if len(there) > count:
        order = np.argsort(-steps.sum(1), kind="stable")
        most, rest = order[: count // 2], np.sort(order[count // 2 :])
        spread = rest[np.linspace(0, len(rest) - 1, count - len(most)).round().astype(int)]
        chosen = np.concatenate([most, spread])
    else:
        chosen = np.arange(count) % len(there)
    return Tracked(points[chosen], visible[chosen])
