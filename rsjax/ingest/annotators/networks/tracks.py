"""Stage "tracks" by networks, each a checkout of its repository: SpatialTracker and BootsTAPIR."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.config import require
from rsjax.ingest.annotators.networks.local import checkout_module, library, load_weights, on_device
from rsjax.ingest.annotators.protocols import AnnotationError, Tracked, require_counts
from rsjax.ingest.annotators.tracks import Followed, track_in_spans
from rsjax.ingest.episode import Depths, Frames

_LEAST_DEPTH = 0.01  # below which SpatialTracker takes a depth for not measured


@dataclass(frozen=True)
class SpatialTracker:
    """SpatialTracker (Xiao et al. 2024), which lifts points into space by the depth that it is given. Needs CUDA.

    Attributes:
        checkout: of its repository.
        weights: ``spaT_final.pth``.
        grid: points begin in the middles of grid × grid cells.
        span: frames that it sees at once; a point that is hidden at a span's end is given up.
        window: frames of its sliding window.
        device: torch's name of it.
    """

    name: ClassVar[str] = "spatial-tracker"
    version: ClassVar[int] = 1
    checkout: Path
    weights: Path
    grid: int = 16
    span: int = 64
    window: int = 12
    device: str = "cuda"

    def __post_init__(self) -> None:
        require_counts(self, "grid", "span", "window")

    def __call__(self, frames: Frames, depth: Depths | None = None) -> Tracked:
        if depth is None:
            raise AnnotationError("SpatialTracker needs the frames' depth; give a depth stage, or take another tracker")
        return track_in_spans(frames, self.follow, self.grid, self.span, depth)

    def follow(
        self,
        pictures: UInt8[np.ndarray, "T H W 3"],
        points: Float32[np.ndarray, "P 2"],
        depth: Float32[np.ndarray, "T H W"] | None,
    ) -> Followed:
        """As :class:`rsjax.ingest.annotators.tracks.Follower`; the depth is needed."""
        torch = library("torch", "SpatialTracker")
        model = self.load()
        size, count = np.array(pictures.shape[2:0:-1], np.float32), len(pictures)
        queries = np.concatenate([np.zeros((len(points), 1)), points * size - 0.5], 1).astype(np.float32)
        # of fewer frames than half its window it says nothing at all: zeros, and no point visible
        kept = np.arange(max(count, self.window)).clip(max=count - 1)
        video = torch.from_numpy(pictures[kept]).to(self.device).permute(0, 3, 1, 2)[None].float()
        maps = torch.from_numpy(_usable(np.asarray(depth, np.float32))[kept]).to(self.device)[:, None]
        with torch.no_grad():
            places, seen, _ = model(
                video,
                video_depth=maps,
                queries=torch.from_numpy(queries)[None].to(self.device),
                wind_length=self.window,
            )
        places, seen = places[0, :count].permute(1, 0, 2).cpu().numpy(), seen[0, :count].permute(1, 0).cpu().numpy()
        return _cleaned((places[..., :2] + 0.5) / size, seen.astype(bool), points)

    def load(self) -> Any:
        """The network, loaded once per process; errors as of :func:`rsjax.ingest.annotators.protocols.prepare`."""
        return _load_spatial(self.checkout, self.weights, self.window, self.device)


@dataclass(frozen=True)
class BootsTapir:
    """BootsTAPIR (Doersch et al. 2024) through the PyTorch model of google-deepmind/tapnet.

    Attributes:
        checkout: of that repository.
        weights: ``bootstapir_checkpoint_v2.pt``.
        grid: points begin in the middles of grid × grid cells.
        span: frames that it sees at once; a point that is hidden at a span's end is given up.
        side: pixels of the square that pictures are resized to, a multiple of 8.
        device: torch's name of it.
    """

    name: ClassVar[str] = "bootstapir"
    version: ClassVar[int] = 1
    checkout: Path
    weights: Path
    grid: int = 16
    span: int = 64
    side: int = 256
    device: str = "cpu"

    def __post_init__(self) -> None:
        require_counts(self, "grid", "span", "side")
        require(self.side % 8 == 0, f"bootstapir: side is {self.side}; it must be a multiple of 8")

    def __call__(self, frames: Frames, depth: Depths | None = None) -> Tracked:
        return track_in_spans(frames, self.follow, self.grid, self.span)

    def follow(
        self,
        pictures: UInt8[np.ndarray, "T H W 3"],
        points: Float32[np.ndarray, "P 2"],
        depth: Float32[np.ndarray, "T H W"] | None = None,
    ) -> Followed:
        """As :class:`rsjax.ingest.annotators.tracks.Follower`; depth is not used."""
        torch = library("torch", "BootsTAPIR")
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

    def load(self) -> Any:
        """The network, loaded once per process; errors as of :func:`rsjax.ingest.annotators.protocols.prepare`."""
        return _load_tapir(self.checkout, self.weights, self.device)


def _usable(depth: Float32[np.ndarray, "T H W"]) -> Float32[np.ndarray, "T H W"]:
    """SpatialTracker divides by the spread of the depth beyond a centimetre, and starts a debugger at the first NaN."""
    measured = depth[depth > _LEAST_DEPTH]
    if not np.isfinite(depth).all() or not measured.size or not np.ptp(measured):
        raise AnnotationError(
            "SpatialTracker needs depth that is finite and not the same everywhere; take another depth or tracker"
        )
    return depth


def _cleaned(places: np.ndarray, seen: np.ndarray, points: np.ndarray) -> Followed:
    """Networks may move a point of the first frame, and call points visible that have left the image."""
    if not np.isfinite(places).all():
        raise AnnotationError("the tracker gave places that are not finite; check its weights and precision")
    seen = seen & ((places >= 0) & (places < 1)).all(-1)
    places[:, 0], seen[:, 0] = points, True
    return places.astype(np.float32), seen


@lru_cache(maxsize=1)
def _load_spatial(checkout: Path, weights: Path, window: int, device: str) -> Any:
    what = "SpatialTracker"
    library("torch", what)
    if not weights.is_file():
        raise AnnotationError(f"{weights}: no such file; {what} needs its weights there (nothing is downloaded)")
    module = checkout_module(checkout, "models.spatracker.predictor", what)
    predictor = module.SpaTrackerPredictor(checkpoint=str(weights), interp_shape=(384, 512), seq_length=window)
    return on_device(predictor, device, what).eval()


@lru_cache(maxsize=1)
def _load_tapir(checkout: Path, weights: Path, device: str) -> Any:
    what = "BootsTAPIR"
    library("torch", what)
    module = checkout_module(checkout, "tapnet.torch.tapir_model", what)
    return on_device(load_weights(module.TAPIR(pyramid_level=1), weights, what), device, what)
