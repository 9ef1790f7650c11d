"""Chooses the clips that reports show (typical and worst ones) and comparisons show (both extremes)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from rsjax.data.clips import Clips
from rsjax.evaluation.registry import PerClip, Scene

EXTREMES = 3  # clips at either end of the ranking that comparisons show


def choose_clips(
    psnr: Float[np.ndarray, " B"], success: Bool[np.ndarray, " B"], count: int
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Chooses clips by PSNR: typical and worst clips in turn, a typical one first.

    Typical clips are those nearest to the median; successes and failures alternate as long as there are both.

    Args:
        count: how many clips; if it is odd, one more of them is typical. At most B are returned.

    Returns:
        The rows of the chosen clips, and each one's rank from the worst: 1 for the worst; 0 for a typical clip.
    """
    count = min(count, len(psnr))
    worst = np.argsort(psnr, kind="stable")[: count // 2]
    nearest = [i for i in np.argsort(np.abs(psnr - np.median(psnr)), kind="stable") if i not in worst]
    queues = [[i for i in nearest if success[i] == outcome] for outcome in (True, False)]
    typical = [queue.pop(0) for _ in nearest for queue in queues if queue][: count - len(worst)]
    rows, ranks = np.empty(count, int), np.zeros(count, int)
    rows[::2], rows[1::2], ranks[1::2] = typical, worst, np.arange(1, len(worst) + 1)
    return rows, ranks


def extremes(
    scores: Float[np.ndarray, " B"], count: int = EXTREMES
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Returns the clips with the lowest scores, lowest first, and those with the highest, highest first.

    Args:
        count: how many of each; fewer if they would overlap.
    """
    order, count = np.argsort(scores, kind="stable"), min(count, len(scores) // 2)
    return order[:count], order[::-1][:count]


def shown_arrays(clips: Clips, scenes: Mapping[str, Scene], psnr: PerClip, count: int) -> dict[str, np.ndarray]:
    """Returns arrays of the clips in the report, in the order of :func:`choose_clips`."""
    ends, own, others = clips.success[:, -1], scenes[""].prediction, scenes[""].alternatives.get("other")
    rows, ranks = choose_clips(psnr, ends, count)
    arrays: dict[str, Any] = {
        "clip": clips.index[rows],
        "task": np.array(clips.task)[rows],
        "psnr": psnr[rows],
        "rank": ranks,
        "truth": clips.rgb[rows],
        "prediction": own.rgb[rows],
        "has_depth": clips.has_depth[rows],
        "metric": clips.metric[rows],
        "true_depth": clips.depth[rows],
        "tracks": clips.tracks[rows],
        "visible": clips.visible[rows],
        "success": ends[rows],
    }
    if others:
        arrays["other_actions"] = others[0].rgb[rows]
    if "_tokenizer" in scenes:
        arrays["reconstruction"] = scenes["_tokenizer"].prediction.rgb[rows]
    return arrays | ({} if own.depth is None else {"predicted_depth": own.depth[rows]})
