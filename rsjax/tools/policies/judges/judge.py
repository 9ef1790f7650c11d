"""The interface of judges, which decide from frames whether a task is done.

Axes: B videos, T frames, H×W pixels.
"""

from typing import Protocol

import numpy as np
from jaxtyping import Float, UInt8

LABELS = ("success", "fail", "uninterpretable")
SUCCESS, FAIL, UNINTERPRETABLE = range(3)
HISTORY = 4  # frames that this package's judges look at; shorter videos are padded by repeating the first frame


class Judge(Protocol):
    """Judges videos by their last frames."""

    def __call__(self, frames: UInt8[np.ndarray, "B T H W 3"]) -> Float[np.ndarray, "B 3"]:
        """Returns the probability of each of ``LABELS`` at the end of each video."""
        ...


def last_frames(frames: UInt8[np.ndarray, "B T H W 3"]) -> UInt8[np.ndarray, "B 4 H W 3"]:
    """Returns the last ``HISTORY`` frames of videos, padded by repeating the first frame."""
    missing = max(0, HISTORY - frames.shape[1])
    return np.concatenate([np.repeat(frames[:, :1], missing, axis=1), frames[:, -HISTORY:]], axis=1)


def judge_key(judge: Judge | None) -> str:
    """Returns a judge's attribute ``key``, its name if it has no ``key`` (such as a function), or "" for None."""
    if judge is None:
        return ""
    return str(getattr(judge, "key", "")) or str(getattr(judge, "__qualname__", type(judge).__qualname__))
