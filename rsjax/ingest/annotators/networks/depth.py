"""Stage "depth" by networks: Video Depth Anything (a checkout), and DepthAnything per frame (transformers)."""

import math
import os
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.ingest.annotators.depth import metric_depth, relative_depth
from rsjax.ingest.annotators.networks.local import checkout_module, library, load_weights, on_device, pretrained
from rsjax.ingest.annotators.protocols import AnnotationError, DepthMaps, in_chunks, require_counts
from rsjax.ingest.episode import Episode, EpisodeError, Frames

Encoder = Literal["vits", "vitb", "vitl"]
_SIZES: dict[str, dict[str, Any]] = {
    "vits": {"encoder": "vits", "features": 64, "out_channels": [48, 96, 192, 384]},
    "vitb": {"encoder": "vitb", "features": 128, "out_channels": [96, 192, 384, 768]},
    "vitl": {"encoder": "vitl", "features": 256, "out_channels": [256, 512, 1024, 1024]},
}


@dataclass(frozen=True)
class VideoDepthAnything:
    """Video Depth Anything (Chen et al. 2025) on a whole episode at once, so that its frames agree.

    Attributes:
        checkout: of its repository.
        weights: ``(metric_)video_depth_anything_vit{s,b,l}.pth``.
        encoder: of these weights.
        metric: whether they are the metric ones: metres instead of relative depth.
        input_size: pixels of the shorter side that the network sees.
        most_frames: of an episode; its frames and maps are all in memory, several times: about 20 bytes a pixel.
        device: torch's name of it.
    """

    name: ClassVar[str] = "video-depth-anything"
    version: ClassVar[int] = 1
    checkout: Path
    weights: Path
    encoder: Encoder = "vits"
    metric: bool = False
    input_size: int = 518
    most_frames: int = 2000
    device: str = "cuda"

    def __post_init__(self) -> None:
        require_counts(self, "input_size", "most_frames")

    def __call__(self, episode: Episode, camera: str) -> DepthMaps:
        frames = _pictures_of(episode, camera)
        if len(frames) > self.most_frames:
            raise AnnotationError(
                f"episode {episode.id}: {len(frames)} frames, more than most_frames {self.most_frames}, which Video "
                f"Depth Anything holds in memory at once; raise that, or cut the episode"
            )
        model = self.load()
        precise = {"fp32": True} if self.device == "cpu" else {}  # older checkouts do not know the option
        options = {"input_size": self.input_size, "device": self.device} | precise
        found, _ = model.infer_video_depth(frames.read(range(len(frames))), episode.fps, **options)
        return _as_maps(np.asarray(found), "metres" if self.metric else "relative", episode, camera, self.name)

    def load(self) -> Any:
        """The network, loaded once per process; errors as of :func:`rsjax.ingest.annotators.protocols.prepare`."""
        return _load_video(self.checkout, self.weights, self.encoder, self.metric, self.device)


@dataclass(frozen=True)
class DepthAnything:
    """DepthAnything (Yang et al. 2024) through transformers, frame by frame: relative depth may flicker.

    An episode's maps are kept in the folder for temporary files until they are stored, 4 bytes a pixel.

    Attributes:
        model: local folder of a ``DepthAnythingForDepthEstimation`` with its image processor. What its configuration
            calls "metric" gives metres, the others relative depth.
        batch: frames at a time.
        device: torch's name of it.
    """

    name: ClassVar[str] = "depth-anything"
    version: ClassVar[int] = 1
    model: Path
    batch: int = 8
    device: str = "cpu"

    def __post_init__(self) -> None:
        require_counts(self, "batch")

    def __call__(self, episode: Episode, camera: str) -> DepthMaps:
        frames = _pictures_of(episode, camera)
        model, processor = self.load()
        found = _on_disk((len(frames), *frames.read([0]).shape[1:3]))
        for start, pictures in in_chunks(frames, size=self.batch):
            found[start : start + len(pictures)] = _estimate(model, processor, pictures, self.device)
        unit: Any = "metres" if model.config.depth_estimation_type == "metric" else "relative"
        return _as_maps(found, unit, episode, camera, self.name)

    def load(self) -> tuple[Any, Any]:
        """The network and its image processor, loaded once per process. Errors likewise."""
        return _load_frames(self.model, self.device)


def _pictures_of(episode: Episode, camera: str) -> Frames:
    if camera not in episode.cameras:
        raise EpisodeError(f"episode {episode.id}: no camera {camera!r}; it has {', '.join(episode.cameras)}")
    return episode.cameras[camera]


def _as_maps(
    found: Float32[np.ndarray, "N H W"], unit: Literal["metres", "relative"], episode: Episode, camera: str, by: str
) -> DepthMaps:
    shape = (len(episode.timestamps), *episode.cameras[camera].read([0]).shape[1:3])
    if found.shape != shape:
        raise AnnotationError(f"{by} gave depth of shape {found.shape} for frames of {shape}; check its version")
    try:
        return metric_depth(found) if unit == "metres" else relative_depth(found)
    except ValueError as error:
        raise AnnotationError(f"episode {episode.id}: {by}: {error}; check weights and precision") from error


def _on_disk(shape: tuple[int, ...]) -> Float32[np.ndarray, "N H W"]:
    """An array in a temporary file that has no name, so that an episode may be longer than memory.

    Raises:
        OSError: no space for it.
    """
    with tempfile.TemporaryFile() as file:
        # A file with holes would be found too large by the write that fills the disk, which kills the process.
        os.posix_fallocate(file.fileno(), 0, 4 * math.prod(shape))
        return np.memmap(file, np.float32, "r+", shape=shape)  # type: ignore[call-overload,no-any-return]


def _estimate(
    model: Any, processor: Any, pictures: UInt8[np.ndarray, "n H W 3"], device: str
) -> Float32[np.ndarray, "n H W"]:
    torch = library("torch", "DepthAnything")
    inputs = processor(images=list(pictures), return_tensors="pt").to(device)
    with torch.no_grad():
        depth = model(**inputs).predicted_depth
        resized = torch.nn.functional.interpolate(depth[:, None].float(), pictures.shape[1:3], mode="bilinear")
    return resized[:, 0].cpu().numpy()


@lru_cache(maxsize=1)
def _load_video(checkout: Path, weights: Path, encoder: str, metric: bool, device: str) -> Any:
    what = "Video Depth Anything"
    library("torch", what)
    module = checkout_module(checkout, "video_depth_anything.video_depth", what)
    options = {"metric": True} if metric else {}  # older checkouts do not know the option
    model = load_weights(module.VideoDepthAnything(**_SIZES[encoder], **options), weights, what)
    return on_device(model, device, what)


@lru_cache(maxsize=1)
def _load_frames(folder: Path, device: str) -> tuple[Any, Any]:
    what = "DepthAnything"
    library("torch", what)
    model = pretrained("AutoModelForDepthEstimation", folder, what).eval()
    return on_device(model, device, what), pretrained("AutoImageProcessor", folder, what)
