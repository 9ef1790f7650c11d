"""Step "depth": fills the holes of recorded depth, and estimates depth by networks.

The networks are Video Depth Anything (a checkout) and DepthAnything for each frame (transformers).

Depth that a network estimates from pictures is mostly relative: 1/depth up to an unknown scale and shift. It is
stretched for each video so that the nearest point is 1 and the farthest is ``RELATIVE_FAR``, without a unit. The
"inverse" colour map over [1, RELATIVE_FAR] then has even steps in the network's output, and ``DepthMaps.extent`` makes
it possible to undo the stretching.
"""

import math
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from rsjax.data.depth_color import RELATIVE_FAR, stretch
from rsjax.tools.ingest.annotators.network import NetworkAnnotator, checkout_module, library, load_weights, pretrained
from rsjax.tools.ingest.annotators.protocols import CHUNK, AnnotationError, DepthMaps, in_chunks
from rsjax.tools.ingest.episode import Depths, Episode, EpisodeError

_NEAR_SHARE = 1 / RELATIVE_FAR  # 1/depth of the farthest point, relative to the nearest
_SIZES: dict[str, dict[str, Any]] = {
    "vits": {"encoder": "vits", "features": 64, "out_channels": [48, 96, 192, 384]},
    "vitb": {"encoder": "vitb", "features": 128, "out_channels": [96, 192, 384, 768]},
    "vitl": {"encoder": "vitl", "features": 256, "out_channels": [256, 512, 1024, 1024]},
}


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
    low = np.inf
    high = -np.inf
    for start in range(0, len(maps), CHUNK):
        chunk = maps[start : start + CHUNK]
        if not np.isfinite(chunk).all():
            raise ValueError("depth is not finite everywhere")
        low = min(low, float(chunk.min()))
        high = max(high, float(chunk.max()))
    return low, high


@dataclass(frozen=True)
class VideoDepthAnything(NetworkAnnotator):
    """Video Depth Anything (Chen et al. 2025) on a whole episode at once, so that its frames agree.

    Attributes:
        checkout: of its repository.
        weights: ``(metric_)video_depth_anything_vit{s,b,l}.pth``.
        encoder: of these weights.
        metric: whether they are the metric ones: metres instead of relative depth.
        input_size: pixels of the shorter side that the network sees.
        most_frames: of an episode; memory holds its frames and maps several times, about 20 bytes a pixel.
    """

    name: ClassVar[str] = "video-depth-anything"
    title: ClassVar[str] = "Video Depth Anything"
    checkout: Path
    weights: Path
    encoder: Literal["vits", "vitb", "vitl"] = "vits"
    metric: bool = False
    input_size: int = 518
    most_frames: int = 2000
    device: str = field(default="cuda", kw_only=True)

    def __call__(self, episode: Episode, camera: str) -> DepthMaps:
        frames = episode.cameras[camera]
        if len(frames) > self.most_frames:
            raise AnnotationError(
                f"episode {episode.id}: {len(frames)} frames, more than most_frames {self.most_frames}, which Video "
                f"Depth Anything holds in memory at once; raise that, or cut the episode"
            )
        model = self.load()
        options: dict[str, Any] = {"input_size": self.input_size, "device": self.device}
        if self.device == "cpu":
            options["fp32"] = True  # older checkouts do not know the option
        maps, _ = model.infer_video_depth(frames.read(range(len(frames))), episode.fps, **options)
        return _as_maps(np.asarray(maps), self.metric, episode, camera, self.name)

    def build(self) -> Any:
        module = checkout_module(self.checkout, "video_depth_anything.video_depth", self.title)
        options = {}
        if self.metric:
            options["metric"] = True  # older checkouts do not know the option
        model = module.VideoDepthAnything(**_SIZES[self.encoder], **options)
        return load_weights(model, self.weights, self.device, self.title)


@dataclass(frozen=True)
class DepthAnything(NetworkAnnotator):
    """DepthAnything (Yang et al. 2024) through transformers, frame by frame: relative depth may flicker.

    An episode's maps stay in the folder for temporary files until they are stored, 4 bytes a pixel.

    Attributes:
        model: local folder of a ``DepthAnythingForDepthEstimation`` with its image processor. It gives metres where its
            configuration says "metric", and relative depth otherwise.
        batch: frames at a time.
    """

    name: ClassVar[str] = "depth-anything"
    title: ClassVar[str] = "DepthAnything"
    model: Path
    batch: int = 8

    def __call__(self, episode: Episode, camera: str) -> DepthMaps:
        frames = episode.cameras[camera]
        model, processor = self.load()
        torch = library("torch", self.title)
        shape = (len(frames), *frames.read([0]).shape[1:3])
        with tempfile.TemporaryFile() as file:  # an episode may exceed the memory
            # In a sparse file, the write that fills the disk would kill the process.
            os.posix_fallocate(file.fileno(), 0, 4 * math.prod(shape))
            maps: Any = np.memmap(file, np.float32, "r+", shape=shape)  # type: ignore[call-overload]
        for start, pictures in in_chunks(frames, size=self.batch):
            inputs = processor(images=list(pictures), return_tensors="pt").to(self.device)
            with torch.no_grad():
                depth = model(**inputs).predicted_depth
                resized = torch.nn.functional.interpolate(depth[:, None].float(), pictures.shape[1:3], mode="bilinear")
            maps[start : start + len(pictures)] = resized[:, 0].cpu().numpy()
        return _as_maps(maps, model.config.depth_estimation_type == "metric", episode, camera, self.name)

    def build(self) -> tuple[Any, Any]:
        return pretrained(("AutoModelForDepthEstimation", "AutoImageProcessor"), self.model, self.device, self.title)


def _as_maps(maps: Float32[np.ndarray, "N H W"], metric: bool, episode: Episode, camera: str, method: str) -> DepthMaps:
    shape = (len(episode.timestamps), *episode.cameras[camera].read([0]).shape[1:3])
    if maps.shape != shape:
        raise AnnotationError(f"{method} gave depth of shape {maps.shape} for frames of {shape}; check its version")
    try:
        if metric:
            return metric_depth(maps)
        return relative_depth(maps)
    except ValueError as error:
        raise AnnotationError(f"episode {episode.id}: {method}: {error}; check weights and precision") from error
