"""Step "motion": measures the motion in each frame by optical flow: DIS without weights, or RAFT (Teed & Deng 2020).

The camera's own motion counts too. :mod:`rsjax.tools.ingest.windows` filters by these values.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32

from rsjax.config import require
from rsjax.tools.ingest.annotators.network import NetworkAnnotator, library, load_weights
from rsjax.tools.ingest.annotators.protocols import Annotator, FlowEstimator, Motion, Pictures, in_chunks
from rsjax.tools.ingest.episode import Frames

WIDTH = 256  # of the picture that motion is scaled to; wider pictures are shrunk before the measurement
_LEAST = 32  # pixels per side; for smaller pictures DIS has no pyramid
_RAFT_MULTIPLE = 8  # of both sides that RAFT accepts, in pixels
_RAFT_LEAST = 128  # likewise


@dataclass(frozen=True)
class DISFlow(Annotator):
    """OpenCV's DIS flow on grey pictures.

    Attributes:
        preset: 0 ultrafast, 1 fast, 2 medium.
    """

    name: ClassVar[str] = "dis"
    preset: int = 1

    def __post_init__(self) -> None:
        require(self.preset in (0, 1, 2), f"dis: preset is {self.preset}; choose 0, 1 or 2")

    def __call__(self, before: Pictures, after: Pictures) -> Float32[np.ndarray, "T H W 2"]:
        method: Any = _dis(self.preset)  # its stub knows no None
        grey = [[cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures] for pictures in (before, after)]
        return np.stack([method.calc(*pair, None) for pair in zip(*grey, strict=True)])


_dis = lru_cache(maxsize=1)(cv2.DISOpticalFlow.create)


def measure_motion(frames: Frames, timestamps: Float[np.ndarray, " N"], flow: FlowEstimator) -> Motion:
    """Measures the motion that leads into each frame.

    Args:
        frames: the frames of one camera.
        timestamps: seconds, increasing; as many as frames.
        flow: the optical-flow method.
    """
    mean, high = np.zeros((2, len(frames)), np.float32)
    for start, pictures in in_chunks(frames, overlap=1):
        if len(pictures) < 2:
            continue
        height, width = pictures.shape[1:3]
        scale = max(min(1.0, WIDTH / width), _LEAST / min(height, width))
        small = pictures
        if scale != 1:
            sides = (round(width * scale), round(height * scale))
            how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
            small = np.stack([cv2.resize(picture, sides, interpolation=how) for picture in pictures])
        field = flow(small[:-1], small[1:])
        # the flow is in pixels of the resized picture, whose sides may have been rounded differently
        unit = WIDTH / pictures.shape[2] * np.array(pictures.shape[2:0:-1]) / np.array(small.shape[2:0:-1])
        speed = np.linalg.norm(field * unit.astype(np.float32), axis=-1).reshape(len(field), -1)
        rows = slice(start + 1, start + len(pictures))
        seconds = np.diff(timestamps[start : start + len(pictures)])
        mean[rows] = speed.mean(1) / seconds
        high[rows] = np.percentile(speed, 95, axis=1) / seconds
    return Motion(mean, high)


@dataclass(frozen=True)
class RaftFlow(NetworkAnnotator):
    """RAFT; pictures are resized to sides that it accepts, and the flow is in pixels of the original ones.

    Attributes:
        weights: torchvision's file, such as ``raft_small_C_T_V2-01064c6d.pth``.
        size: of the network.
        updates: of the flow, by the recurrent part.
        batch: pairs at a time.
    """

    name: ClassVar[str] = "raft"
    title: ClassVar[str] = "RAFT"
    weights: Path
    size: Literal["small", "large"] = "small"
    updates: int = 12
    batch: int = 8

    def __call__(self, before: Pictures, after: Pictures) -> Float32[np.ndarray, "T H W 2"]:
        model = self.load()
        torch = library("torch", self.title)
        resize = torch.nn.functional.interpolate
        height, width = before.shape[1:3]
        size = [max(_RAFT_LEAST, round(side / _RAFT_MULTIPLE) * _RAFT_MULTIPLE) for side in (height, width)]
        unit = np.array([width / size[1], height / size[0]], np.float32)
        flows = [np.zeros((0, height, width, 2), np.float32)]
        for start in range(0, len(before), self.batch):
            pair = [torch.from_numpy(x[start : start + self.batch]).to(self.device) for x in (before, after)]
            pair = [x.permute(0, 3, 1, 2).float() / 127.5 - 1 for x in pair]
            with torch.no_grad():
                pair = [resize(x, size, mode="bilinear", antialias=True) for x in pair]
                flow = model(*pair, num_flow_updates=self.updates)[-1]
                flow = resize(flow, (height, width), mode="bilinear")
            flows.append(flow.permute(0, 2, 3, 1).cpu().numpy() * unit)
        return np.concatenate(flows)

    def build(self) -> Any:
        flows = library("torchvision.models.optical_flow", self.title)
        model = getattr(flows, f"raft_{self.size}")(weights=None)
        return load_weights(model, self.weights, self.device, f"{self.title} ({self.size})")
