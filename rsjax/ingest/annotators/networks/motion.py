"""Stage "motion" by RAFT (torchvision; Teed & Deng 2020)."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.ingest.annotators.networks.local import library, load_weights, on_device
from rsjax.ingest.annotators.protocols import require_counts

_MULTIPLE, _LEAST = 8, 128  # what RAFT asks of both sides, in pixels


@dataclass(frozen=True)
class RaftFlow:
    """RAFT; pictures are resized to sides that it takes, and the flow is told in pixels of the picture given.

    Attributes:
        weights: torchvision's file, such as ``raft_small_C_T_V2-01064c6d.pth``.
        size: of the network.
        updates: of the flow, by the recurrent part.
        batch: pairs at a time.
        device: torch's name of it.
    """

    name: ClassVar[str] = "raft"
    version: ClassVar[int] = 1
    weights: Path
    size: Literal["small", "large"] = "small"
    updates: int = 12
    batch: int = 8
    device: str = "cpu"

    def __post_init__(self) -> None:
        require_counts(self, "updates", "batch")

    def __call__(
        self, before: UInt8[np.ndarray, "T H W 3"], after: UInt8[np.ndarray, "T H W 3"]
    ) -> Float32[np.ndarray, "T H W 2"]:
        model = self.load()
        parts = [
            self._flow(model, before[i : i + self.batch], after[i : i + self.batch])
            for i in range(0, len(before), self.batch)
        ]
        return np.concatenate(parts) if parts else np.zeros((*before.shape[:3], 2), np.float32)

    def load(self) -> Any:
        """The network, loaded once per process; errors as of :func:`rsjax.ingest.annotators.protocols.prepare`."""
        return _load(self.weights, self.size, self.device)

    def _flow(self, model: Any, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        torch = library("torch", "RAFT")
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


@lru_cache(maxsize=1)
def _load(weights: Path, size: str, device: str) -> Any:
    flows = library("torchvision.models.optical_flow", "RAFT")
    model = getattr(flows, f"raft_{size}")(weights=None)
    return on_device(load_weights(model, weights, f"RAFT ({size})"), device, "RAFT")
