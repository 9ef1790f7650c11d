"""The interface of judges, which decide from frames whether a task is done.

Axes: B videos, T frames, H×W pixels.
"""

from dataclasses import replace
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


def last_frames(frames: UInt8[np.ndarray, "B T H W 3"], count: int = HISTORY) -> UInt8[np.ndarray, "B F H W 3"]:
    """Returns the last ``count`` frames of videos, padded by repeating the first frame."""
    missing = max(0, count - frames.shape[1])
    return np.concatenate([np.repeat(frames[:, :1], missing, axis=1), frames[:, -count:]], axis=1)


def frames_of(judge: object) -> int:
    """Returns how many of a video's last frames decide a judge's verdict at its end."""
    return HISTORY + getattr(judge, "in_a_row", 1) - 1


def of_single_frames(judge: Judge) -> Judge:
    """Returns the judge that asks for one frame of success instead of several in a row."""
    if getattr(judge, "in_a_row", 1) == 1:
        return judge
    return replace(judge, in_a_row=1)  # type: ignore[type-var]


def all_successes(verdicts: Float[np.ndarray, "n B 3"]) -> Float[np.ndarray, "B 3"]:
    """Returns the last of n verdicts in a row, with the least of their probabilities of success; failure is the rest.

    So a single frame that looks like success is not a success yet.
    """
    last = verdicts[-1].copy()
    least = verdicts[..., SUCCESS].min(axis=0)
    last[:, FAIL] += last[:, SUCCESS] - least
    last[:, SUCCESS] = least
    return last


def judge_key(judge: object) -> str:
    """Returns a judge's attribute ``key``, its name if it has no ``key`` (such as a function), or "" for None."""
    if judge is None:
        return ""
    return str(getattr(judge, "key", "")) or str(getattr(judge, "__qualname__", type(judge).__qualname__))
