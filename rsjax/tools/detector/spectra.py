"""A detector of generated clips: logistic regression on the spectra of frames.

A tokenizer's decoder draws too little of the finest detail, and repeats the grid of its tokens. Both show in how power
is spread over spatial frequencies.

Axes: N videos, T frames, H×W pixels, S×S after scaling, C = 3 channels (Y, Cb, Cr), R rings of frequencies, F features.
"""

import hashlib
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import safetensors
import safetensors.numpy
from jaxtyping import Float, UInt8

from rsjax.errors import UserError, first_line
from rsjax.files import read_json, regular, write_file, write_json
from rsjax.tools.logistic_regression import LogisticRegression

SIDE = 64  # pixels; other frames are scaled
RINGS = 24
FEATURES = 3 * RINGS
MOST_FRAMES = 128  # of a video file; the first ones
TENSORS = "detector.safetensors"
RECORD = "detector.json"
SHIPPED = Path(__file__).parent / "weights"
AGAIN = "train it again with rsjax detect --train RUN"
# ITU-R BT.601, as JPEG and most video store colours.
YCBCR = np.array([[0.299, 0.587, 0.114], [-0.1687, -0.3313, 0.5], [0.5, -0.4187, -0.0813]], np.float32)


@dataclass(frozen=True)
class Detector:
    """A rule on the features of videos, in which generated ones are positive, and half of all.

    Attributes:
        about: what it was trained on, JSON-ready.
    """

    rule: LogisticRegression
    about: dict[str, Any] = field(default_factory=dict)

    def __call__(self, features: Float[np.ndarray, "N F"]) -> Float[np.ndarray, " N"]:
        """Returns the probability that each video is generated."""
        return self.rule(features)

    def save(self, folder: Path) -> None:
        """Writes what :func:`load_detector` reads: the tensors, and a record with their SHA-256."""
        tensors = safetensors.numpy.save(
            {name: np.atleast_1d(x).astype(np.float32) for name, x in vars(self.rule).items()}
        )
        write_file(folder / TENSORS, tensors)
        write_json(folder / RECORD, {"sha256": hashlib.sha256(tensors).hexdigest(), "about": self.about})


def load_detector(folder: Path = SHIPPED) -> Detector:
    """Reads a detector; by default, the one in the package.

    Raises:
        UserError: there is none, or it is damaged.
    """
    path = folder / TENSORS
    record = read_json(folder / RECORD, cure=AGAIN)
    try:
        payload = regular(path).read_bytes()
        tensors = safetensors.numpy.load(payload)
    except FileNotFoundError as error:
        raise UserError(f"{path}: no detector there; train one with rsjax detect --train RUN") from error
    except (safetensors.SafetensorError, OSError) as error:
        raise UserError(f"{path}: damaged ({first_line(error)}); {AGAIN}") from error
    if record.get("sha256") != hashlib.sha256(payload).hexdigest():
        raise UserError(f"{path}: damaged: its SHA-256 is not the one that {RECORD} records; {AGAIN}")
    shapes = {"mean": (FEATURES,), "scale": (FEATURES,), "weights": (FEATURES,), "bias": (1,)}
    if {name: x.shape for name, x in tensors.items()} != shapes:
        raise UserError(f"{path}: is of another version; {AGAIN}")
    parts = {name: x.astype(float) for name, x in tensors.items()}
    rule = LogisticRegression(parts["mean"], parts["scale"], parts["weights"], float(parts["bias"][0]))
    return Detector(rule, record.get("about", {}))


def video_features(frames: UInt8[np.ndarray, "T H W 3"]) -> Float[np.ndarray, " F"]:
    """Returns the features of a video: the log power in each ring of each channel, averaged over its frames."""
    window, rings = _window_and_rings()
    pictures = channels(frames)
    centred = pictures - pictures.mean((-2, -1), keepdims=True)
    power = np.abs(np.fft.rfft2(centred * window)) ** 2
    in_rings = power.reshape(*power.shape[:-2], -1) @ rings
    return np.log(in_rings + 1).mean(0).ravel()


def channels(frames: UInt8[np.ndarray, "T H W 3"]) -> Float[np.ndarray, "T 3 S S"]:
    """Returns Y, Cb and Cr of the middle square of each frame, scaled to ``SIDE`` pixels."""
    height, width = frames.shape[1:3]
    side = min(height, width)
    top = (height - side) // 2
    left = (width - side) // 2
    square = frames[:, top : top + side, left : left + side]
    if side != SIDE:
        square = np.stack([cv2.resize(each, (SIDE, SIDE), interpolation=cv2.INTER_AREA) for each in square])
    return np.moveaxis(square.astype(np.float32) @ YCBCR.T, -1, 1)


@cache
def _window_and_rings() -> tuple[Float[np.ndarray, "S S"], Float[np.ndarray, "K R"]]:
    """Returns a Hann window, and for each of the K frequencies its share in the mean of each ring."""
    across = np.hanning(SIDE)
    rows = np.abs(np.fft.fftfreq(SIDE))[:, None]
    radius = np.hypot(rows, np.fft.rfftfreq(SIDE)[None])
    ring = np.minimum(radius / radius.max() * RINGS, RINGS - 1).astype(int).ravel()
    member = (ring[:, None] == np.arange(RINGS)).astype(np.float32)
    return across[:, None] * across[None], member / member.sum(0)
