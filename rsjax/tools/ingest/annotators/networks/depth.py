"""Stage "depth" by networks: Video Depth Anything (a checkout), and DepthAnything per frame (transformers)."""

import math
import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float32

from rsjax.tools.ingest.annotators.depth import metric_depth, relative_depth
from rsjax.tools.ingest.annotators.networks.local import Network, checkout_module, library, load_weights, pretrained
from rsjax.tools.ingest.annotators.protocols import AnnotationError, DepthMaps, Pictures, in_chunks
from rsjax.tools.ingest.episode import Episode

_SIZES: dict[str, dict[str, Any]] = {
    "vits": {"encoder": "vits", "features": 64, "out_channels": [48, 96, 192, 384]},
    "vitb": {"encoder": "vitb", "features": 128, "out_channels": [96, 192, 384, 768]},
    "vitl": {"encoder": "vitl", "features": 256, "out_channels": [256, 512, 1024, 1024]},
}


@dataclass(frozen=True)
class VideoDepthAnything(Network):
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
        precise = {"fp32": True} if self.device == "cpu" else {}  # older checkouts do not know the option
        options = {"input_size": self.input_size, "device": self.device} | precise
        maps, _ = model.infer_video_depth(frames.read(range(len(frames))), episode.fps, **options)
        return _as_maps(np.asarray(maps), self.metric, episode, camera, self.name)

    def build(self) -> Any:
        module = checkout_module(self.checkout, "video_depth_anything.video_depth", self.title)
        options = {"metric": True} if self.metric else {}  # older checkouts do not know the option
        model = module.VideoDepthAnything(**_SIZES[self.encoder], **options)
        return load_weights(model, self.weights, self.device, self.title)


@dataclass(frozen=True)
class DepthAnything(Network):
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
        maps = _on_disk((len(frames), *frames.read([0]).shape[1:3]))
        for start, pictures in in_chunks(frames, size=self.batch):
            maps[start : start + len(pictures)] = self._estimate(model, processor, pictures)
        return _as_maps(maps, model.config.depth_estimation_type == "metric", episode, camera, self.name)

    def build(self) -> tuple[Any, Any]:
        return pretrained(("AutoModelForDepthEstimation", "AutoImageProcessor"), self.model, self.device, self.title)

    def _estimate(self, model: Any, processor: Any, pictures: Pictures) -> Float32[np.ndarray, "T H W"]:
        torch = library("torch", self.title)
        inputs = processor(images=list(pictures), return_tensors="pt").to(self.device)
        with torch.no_grad():
            depth = model(**inputs).predicted_depth
            resized = torch.nn.functional.interpolate(depth[:, None].float(), pictures.shape[1:3], mode="bilinear")
        return resized[:, 0].cpu().numpy()


def _as_maps(maps: Float32[np.ndarray, "N H W"], metric: bool, episode: Episode, camera: str, method: str) -> DepthMaps:
    shape = (len(episode.timestamps), *episode.cameras[camera].read([0]).shape[1:3])
    if maps.shape != shape:
        raise AnnotationError(f"{method} gave depth of shape {maps.shape} for frames of {shape}; check its version")
    try:
        return metric_depth(maps) if metric else relative_depth(maps)
    except ValueError as error:
        raise AnnotationError(f"episode {episode.id}: {method}: {error}; check weights and precision") from error


def _on_disk(shape: tuple[int, ...]) -> Float32[np.ndarray, "N H W"]:
    """Makes an array in a temporary file without a name, so that an episode may exceed the memory.

    Raises:
        OSError: the disk has no space for it.
    """
    with tempfile.TemporaryFile() as file:
        # In a sparse file, the write that fills the disk would kill the process.
        os.posix_fallocate(file.fileno(), 0, 4 * math.prod(shape))
        return np.memmap(file, np.float32, "r+", shape=shape)  # type: ignore[call-overload,no-any-return]
