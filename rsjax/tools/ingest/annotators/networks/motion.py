"""Stage "motion" by RAFT (torchvision; Teed & Deng 2020)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float32

from rsjax.tools.ingest.annotators.networks.local import Network, library, load_weights
from rsjax.tools.ingest.annotators.protocols import Pictures

_MULTIPLE, _LEAST = 8, 128  # of both sides that RAFT accepts, in pixels


@dataclass(frozen=True)
class RaftFlow(Network):
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
        starts = range(0, len(before), self.batch)
        flows = [self._flow(model, before[i : i + self.batch], after[i : i + self.batch]) for i in starts]
        return np.concatenate(flows) if flows else np.zeros((*before.shape[:3], 2), np.float32)

    def build(self) -> Any:
        flows = library("torchvision.models.optical_flow", self.title)
        model = getattr(flows, f"raft_{self.size}")(weights=None)
        return load_weights(model, self.weights, self.device, f"{self.title} ({self.size})")

    def _flow(self, model: Any, before: Pictures, after: Pictures) -> Float32[np.ndarray, "T H W 2"]:
        torch = library("torch", self.title)
        height, width = before.shape[1:3]
        size = [max(_LEAST, round(side / _MULTIPLE) * _MULTIPLE) for side in (height, width)]
        resize = torch.nn.functional.interpolate
        pair = [torch.from_numpy(x).to(self.device).permute(0, 3, 1, 2).float() / 127.5 - 1 for x in (before, after)]
        with torch.no_grad():
            pair = [resize(x, size, mode="bilinear", antialias=True) for x in pair]
            flow = model(*pair, num_flow_updates=self.updates)[-1]
            flow = resize(flow, (height, width), mode="bilinear")
        unit = np.array([width / size[1], height / size[0]], np.float32)
        return flow.permute(0, 2, 3, 1).cpu().numpy() * unit
