"""Stage "tracks" by networks, each from a checkout of its repository: SpatialTracker and BootsTAPIR."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np

from rsjax.config import require
from rsjax.tools.ingest.annotators.networks.local import (
    Network,
    checkout_module,
    library,
    load_weights,
    on_device,
    require_weights,
)
from rsjax.tools.ingest.annotators.protocols import AnnotationError, Pictures
from rsjax.tools.ingest.annotators.tracks import Followed, GridTracker, Maps, Points

_LEAST_DEPTH = 0.01  # below which SpatialTracker takes a depth as not measured


@dataclass(frozen=True)
class SpatialTracker(GridTracker, Network):
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
        size, count = np.array(pictures.shape[2:0:-1], np.float32), len(pictures)
        queries = np.concatenate([np.zeros((len(points), 1)), points * size - 0.5], 1).astype(np.float32)
        # for fewer frames than half its window its output is zeros, with no point visible
        kept = np.arange(max(count, self.window)).clip(max=count - 1)
        video = torch.from_numpy(pictures[kept]).to(self.device).permute(0, 3, 1, 2)[None].float()
        maps = torch.from_numpy(_usable(np.asarray(depth, np.float32))[kept]).to(self.device)[:, None]
        rows = torch.from_numpy(queries)[None].to(self.device)
        with torch.no_grad():
            places, seen, _ = model(video, video_depth=maps, queries=rows, wind_length=self.window)
        places, seen = places[0, :count].permute(1, 0, 2).cpu().numpy(), seen[0, :count].permute(1, 0).cpu().numpy()
        return _cleaned((places[..., :2] + 0.5) / size, seen.astype(bool), points)

    def build(self) -> Any:
        require_weights(self.weights, self.title)
        module = checkout_module(self.checkout, "models.spatracker.predictor", self.title)
        options = {"checkpoint": str(self.weights), "interp_shape": (384, 512), "seq_length": self.window}
        return on_device(module.SpaTrackerPredictor(**options), self.device, self.title)


@dataclass(frozen=True)
class BootsTapir(GridTracker, Network):
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
            found = model(video, torch.from_numpy(rows.astype(np.float32))[None].to(self.device))
            hidden, far = torch.sigmoid(found["occlusion"][0]), torch.sigmoid(found["expected_dist"][0])
        seen = ((1 - hidden) * (1 - far) > 0.5).cpu().numpy()
        return _cleaned(found["tracks"][0].cpu().numpy() / self.side, seen, points)

    def build(self) -> Any:
        module = checkout_module(self.checkout, "tapnet.torch.tapir_model", self.title)
        return load_weights(module.TAPIR(pyramid_level=1), self.weights, self.device, self.title)


def _usable(depth: Maps) -> Maps:
    """Checks the depth: SpatialTracker divides by its spread beyond a centimetre, and NaN starts its debugger."""
    measured = depth[depth > _LEAST_DEPTH]
    if not np.isfinite(depth).all() or not measured.size or not np.ptp(measured):
        raise AnnotationError(
            "SpatialTracker needs depth that is finite and not the same everywhere; choose another depth or tracker"
        )
    return depth


def _cleaned(places: np.ndarray, seen: np.ndarray, points: Points) -> Followed:
    """Undoes what networks do amiss: they move points of the first frame, and call points outside visible."""
    if not np.isfinite(places).all():
        raise AnnotationError("the tracker gave places that are not finite; check its weights and precision")
    seen = seen & ((places >= 0) & (places < 1)).all(-1)
    places[:, 0], seen[:, 0] = points, True
    return places.astype(np.float32), seen
