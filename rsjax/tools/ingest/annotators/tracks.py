"""Step "tracks": follows points through a shot: Lucas–Kanade without weights, or SpatialTracker or BootsTAPIR.

Every tracker follows a set of points through a few pictures, a span; :func:`track_in_spans` does the rest. Points begin
on a grid. Those that are visible at a span's end are followed further, and grid cells that lost their points get new
ones.

Axes: P points, T frames, H×W pixels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from rsjax.config import require
from rsjax.tools.ingest.annotators.network import (
    NetworkAnnotator,
    checkout_module,
    library,
    load_weights,
    on_device,
    require_weights,
)
from rsjax.tools.ingest.annotators.protocols import AnnotationError, Annotator, Pictures, Tracked
from rsjax.tools.ingest.episode import Depths, Frames

Points = Float32[np.ndarray, "P 2"]
Maps = Float32[np.ndarray, "T H W"]
Followed = tuple[Float32[np.ndarray, "P T 2"], Bool[np.ndarray, "P T"]]
Follower = Callable[[Pictures, Points, Maps | None], Followed]
_LEAST_DEPTH = 0.01  # below which SpatialTracker takes a depth as not measured


@dataclass(frozen=True, kw_only=True)
class GridTracker(Annotator):
    """Base class of the trackers.

    Attributes:
        grid: points begin in the middles of grid × grid cells.
        span: frames after which cells that lost their points get new ones; a network sees a whole span at once.
        needs_depth: whether :meth:`follow` uses the depth.
    """

    needs_depth: ClassVar[bool] = False
    grid: int = 16
    span: int = 16

    def __call__(self, frames: Frames, depth: Depths | None = None) -> Tracked:
        if self.needs_depth and depth is None:
            raise AnnotationError(f"{self.name} needs the frames' depth; add a depth stage, or choose another tracker")
        return track_in_spans(frames, self.follow, self.grid, self.span, depth if self.needs_depth else None)

    def follow(self, pictures: Pictures, points: Points, depth: Maps | None = None) -> Followed:
        """Follows points of the first picture through the other pictures.

        Args:
            points: x and y, 0 and 1 at the image's outer edges.
            depth: the pictures' depth maps, if the tracker needs them.

        Returns:
            The points in every picture, and whether each is visible in it.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class LucasKanade(GridTracker):
    """Pyramidal Lucas–Kanade; a point that does not return when followed back is lost.

    A point stays while its patch is the same as in the picture in which it last moved, even on a surface without
    texture: if the camera moves over such a surface, the tracker does not notice. Then it is followed from that picture
    to the present one, so that motion too slow to show from one picture to the next adds up; if that fails, from the
    previous picture. In the last picture of a span every point is followed, since the next span knows no earlier one. A
    lost point reappears only where it was lost, when its patch reappears.

    Attributes:
        window: side of the patch that is matched, in pixels.
        levels: levels of the pyramid, in addition to the picture itself.
        tolerance: how far from its start a point may end when it is followed forward and back, in pixels.
        likeness: least correlation of a point's patch with the one it is followed from; less means another surface.
        still: grey levels (of 255) by which a pixel of a patch may change while the patch counts as the same.
    """

    name: ClassVar[str] = "lucas-kanade"
    version: ClassVar[int] = 2
    least: ClassVar[dict[str, int]] = {"window": 3, "levels": 0}
    window: int = 9
    levels: int = 3
    tolerance: float = 0.5
    likeness: float = 0.8
    still: float = 8.0

    def follow(self, pictures: Pictures, points: Points, depth: Maps | None = None) -> Followed:
        grey = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures]
        size = np.array(pictures.shape[2:0:-1], np.float32)
        place = points.astype(np.float32) * size - 0.5
        in_sight = np.ones(len(points), bool)
        patch = _patches(grey[0], place, self.window)
        reference = np.zeros(len(points), int)  # the number of the picture that a point's place and patch are of
        places = [place]
        visible = [in_sight]
        for number, picture in enumerate(grey[1:], 1):
            stays = np.abs(_patches(picture, place, self.window) - patch).max(1, initial=0.0) <= self.still
            going = in_sight & ~stays
            if number == len(grey) - 1:  # the next span knows no earlier picture
                going = in_sight
            place = place.copy()
            in_sight = stays & ~going
            for earlier in np.unique(reference[going]):
                some = np.flatnonzero(going & (reference == earlier))
                place[some], in_sight[some] = self._step(grey[earlier], picture, place[some])
            again = np.flatnonzero(going & ~in_sight & (reference < number - 1))
            place[again], in_sight[again] = self._step(grey[number - 1], picture, place[again])
            in_sight = in_sight | stays
            moved = np.flatnonzero(going & in_sight)
            patch[moved] = _patches(picture, place[moved], self.window)
            reference[moved] = number
            places.append(place)
            visible.append(in_sight)
        return ((np.stack(places, 1) + 0.5) / size).astype(np.float32), np.stack(visible, 1)

    def _step(
        self, before: UInt8[np.ndarray, "H W"], after: UInt8[np.ndarray, "H W"], start: Points
    ) -> tuple[Points, Bool[np.ndarray, " P"]]:
        """Moves points from one picture to another; points that are lost (False) stay where they are."""
        if not len(start):
            return start, np.zeros(0, bool)
        options: Any = {"winSize": (self.window, self.window), "maxLevel": self.levels}
        lucas_kanade: Any = cv2.calcOpticalFlowPyrLK  # its stub knows no None
        end, found, _ = lucas_kanade(before, after, start, None, **options)
        back, found_back, _ = lucas_kanade(after, before, end, None, **options)
        came_back = np.linalg.norm(back - start, axis=-1) <= self.tolerance
        inside = ((end >= -0.5) & (end < np.array(after.shape[::-1]) - 0.5)).all(-1)
        kept = (found[:, 0] == 1) & (found_back[:, 0] == 1) & came_back & inside
        kept[kept] = _likeness(before, after, start[kept], end[kept], self.window) >= self.likeness
        return np.where(kept[:, None], end, start), kept


def _likeness(before: np.ndarray, after: np.ndarray, start: Points, end: Points, side: int) -> np.ndarray:
    """Correlates the patches around two sets of points; the result is about 1 where both patches are uniform."""
    left = _patches(before, start, side)
    right = _patches(after, end, side)
    left = left - left.mean(1, keepdims=True)
    right = right - right.mean(1, keepdims=True)
    even = np.float32(side * side)  # a variance of one grey level is noise
    scale = np.sqrt((left**2).sum(1) * (right**2).sum(1))
    return ((left * right).sum(1) + even) / (scale + even)


def _patches(picture: np.ndarray, points: Points, side: int) -> Float32[np.ndarray, "P side*side"]:
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
        frames: the pictures, at least one.
        follow: the tracker's method.
        grid: at the start of each span, each of grid × grid cells has at least one point.
        span: steps from the first picture of a span to its last, which is the next span's first.
        depth: depth maps to pass on to ``follow``.
    """
    count = len(frames)
    points = np.zeros((0, count, 2), np.float32)
    visible = np.zeros((0, count), bool)
    for start in range(0, max(count - 1, 1), span):
        end = min(start + span + 1, count)
        seeds = grid_points(grid, points[visible[:, start], start])
        points = np.concatenate([points, np.repeat(seeds[:, None], count, 1)])
        visible = np.concatenate([visible, np.zeros((len(seeds), count), bool)])
        visible[len(visible) - len(seeds) :, start] = True
        going = np.flatnonzero(visible[:, start])
        if depth:
            maps = depth.read(range(start, end))
        else:
            maps = None
        places, visible_here = follow(frames.read(range(start, end)), points[going, start], maps)
        points[going, start:end] = places
        points[going, end:] = places[:, -1:]
        visible[going, start + 1 : end] = visible_here[:, 1:]
    return Tracked(points, visible)


def grid_points(grid: int, taken: Float[np.ndarray, "Q 2"]) -> Points:
    """Returns the centres of those of grid × grid cells that contain none of the points ``taken``."""
    ticks = (np.arange(grid, dtype=np.float32) + 0.5) / grid
    middles = np.stack(np.meshgrid(ticks, ticks), -1)  # row, column, (x, y)
    column, row = np.clip((taken * grid).astype(int), 0, grid - 1).T
    free = np.ones((grid, grid), bool)
    free[row, column] = False
    return middles[free]


def window_tracks(tracked: Tracked, frames: Int[np.ndarray, " T"] | Sequence[int], count: int) -> Tracked:
    """Returns ``count`` tracks of a window of these frames, in the form of :class:`rsjax.clip.Clip`.

    Only points that are visible in the window's first frame are used. If there are more than ``count``, half of the
    tracks are the points that move most, and the others are spread evenly over the rest; if there are fewer, points are
    repeated.

    Raises:
        ValueError: no point is visible in the first frame; this cannot happen within one tracked shot.
    """
    frames = np.asarray(frames)
    first = np.flatnonzero(tracked.visible[:, frames[0]])
    if not len(first):
        raise ValueError(f"no point is seen in frame {frames[0]}")
    points = tracked.points[first][:, frames]
    visible = tracked.visible[first][:, frames]
    steps = np.linalg.norm(np.diff(points, axis=1), axis=-1) * (visible[:, 1:] & visible[:, :-1])
    if len(first) > count:
        order = np.argsort(-steps.sum(1), kind="stable")
        most = order[: count // 2]
        rest = np.sort(order[count // 2 :])
        spread = rest[np.linspace(0, len(rest) - 1, count - len(most)).round().astype(int)]
        chosen = np.concatenate([most, spread])
    else:
        chosen = np.arange(count) % len(first)
    return Tracked(points[chosen], visible[chosen])


@dataclass(frozen=True)
class SpatialTracker(GridTracker, NetworkAnnotator):
    """SpatialTracker (Xiao et al. 2024), which lifts points into space by their depth. Needs CUDA.

    A point that is hidden at a span's end is dropped.

    Attributes:
        checkout: of its repository.
        weights: ``spaT_final.pth``.
        window: frames of its sliding window.
    """

    name: ClassVar[str] = "spatial-tracker"
    title: ClassVar[str] = "SpatialTracker"
    needs_depth: ClassVar[bool] = True
    checkout: Path
    weights: Path
    window: int = 12
    span: int = field(default=64, kw_only=True)
    device: str = field(default="cuda", kw_only=True)

    def follow(self, pictures: Pictures, points: Points, depth: Maps | None = None) -> Followed:
        torch = library("torch", self.title)
        model = self.load()
        size = np.array(pictures.shape[2:0:-1], np.float32)
        count = len(pictures)
        queries = np.concatenate([np.zeros((len(points), 1)), points * size - 0.5], 1).astype(np.float32)
        # for fewer frames than half its window its output is zeros, with no point visible
        kept = np.arange(max(count, self.window)).clip(max=count - 1)
        video = torch.from_numpy(pictures[kept]).to(self.device).permute(0, 3, 1, 2)[None].float()
        measured = np.asarray(depth, np.float32)
        beyond = measured[measured > _LEAST_DEPTH]
        # SpatialTracker divides by the spread of depth beyond a centimetre, and NaN starts its debugger.
        if not np.isfinite(measured).all() or not beyond.size or not np.ptp(beyond):
            raise AnnotationError(
                "SpatialTracker needs depth that is finite and not the same everywhere; choose another depth or tracker"
            )
        maps = torch.from_numpy(measured[kept]).to(self.device)[:, None]
        rows = torch.from_numpy(queries)[None].to(self.device)
        with torch.no_grad():
            places, in_sight, _ = model(video, video_depth=maps, queries=rows, wind_length=self.window)
        places = places[0, :count].permute(1, 0, 2).cpu().numpy()
        in_sight = in_sight[0, :count].permute(1, 0).cpu().numpy()
        return _cleaned((places[..., :2] + 0.5) / size, in_sight.astype(bool), points)

    def build(self) -> Any:
        require_weights(self.weights, self.title)
        module = checkout_module(self.checkout, "models.spatracker.predictor", self.title)
        options = {"checkpoint": str(self.weights), "interp_shape": (384, 512), "seq_length": self.window}
        return on_device(module.SpaTrackerPredictor(**options), self.device, self.title)


@dataclass(frozen=True)
class BootsTapir(GridTracker, NetworkAnnotator):
    """BootsTAPIR (Doersch et al. 2024), the PyTorch model of google-deepmind/tapnet.

    A point that is hidden at a span's end is dropped.

    Attributes:
        checkout: of that repository.
        weights: ``bootstapir_checkpoint_v2.pt``.
        side: pixels of the square that pictures are resized to, a multiple of 8.
    """

    name: ClassVar[str] = "bootstapir"
    title: ClassVar[str] = "BootsTAPIR"
    checkout: Path
    weights: Path
    side: int = 256
    span: int = field(default=64, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.side % 8 == 0, f"bootstapir: side is {self.side}; it must be a multiple of 8")

    def follow(self, pictures: Pictures, points: Points, depth: Maps | None = None) -> Followed:
        torch = library("torch", self.title)
        model = self.load()
        sides = (self.side, self.side)
        square = np.stack([cv2.resize(picture, sides, interpolation=cv2.INTER_AREA) for picture in pictures])
        video = torch.from_numpy(square).to(self.device)[None].float() / 127.5 - 1
        rows = np.concatenate([np.zeros((len(points), 1)), points[:, ::-1] * self.side], 1)  # frame, y, x
        with torch.no_grad():
            output = model(video, torch.from_numpy(rows.astype(np.float32))[None].to(self.device))
            hidden = torch.sigmoid(output["occlusion"][0])
            far = torch.sigmoid(output["expected_dist"][0])
        in_sight = ((1 - hidden) * (1 - far) > 0.5).cpu().numpy()
        return _cleaned(output["tracks"][0].cpu().numpy() / self.side, in_sight, points)

    def build(self) -> Any:
        module = checkout_module(self.checkout, "tapnet.torch.tapir_model", self.title)
        return load_weights(module.TAPIR(pyramid_level=1), self.weights, self.device, self.title)


def _cleaned(places: np.ndarray, in_sight: np.ndarray, points: Points) -> Followed:
    """Undoes what networks do amiss: they move points of the first frame, and call points outside visible."""
    if not np.isfinite(places).all():
        raise AnnotationError("the tracker gave places that are not finite; check its weights and precision")
    in_sight = in_sight & ((places >= 0) & (places < 1)).all(-1)
    places[:, 0] = points
    in_sight[:, 0] = True
    return places.astype(np.float32), in_sight
