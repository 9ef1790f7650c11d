"""Chooses the clips that reports show (typical and worst ones) and comparisons show (both extremes)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from rsjax.data.clips import Clips, spread
from rsjax.evaluation.registry import PerClip, Scene

REPORT_CLIPS = 6  # clips that a report shows: half typical ones, half the worst
EXTREMES = 3  # clips at either end of the ranking that comparisons show
KEPT_CLIPS = 24  # clips whose frames are kept for comparisons, spread evenly; those of :func:`extremes` are added


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
    rows = np.empty(count, int)
    rows[::2] = typical
    rows[1::2] = worst
    ranks = np.zeros(count, int)
    ranks[1::2] = np.arange(1, len(worst) + 1)
    return rows, ranks


def extremes(
    scores: Float[np.ndarray, " B"], count: int = EXTREMES
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Returns the clips with the lowest scores, lowest first, and those with the highest, highest first.

    Args:
        count: how many of each; fewer if they would overlap.
    """
    order = np.argsort(scores, kind="stable")
    count = min(count, len(scores) // 2)
    return order[:count], order[::-1][:count]


def shown_arrays(clips: Clips, scenes: Mapping[str, Scene], psnr: PerClip) -> dict[str, np.ndarray]:
    """Returns arrays of the clips in the report, in the order of :func:`choose_clips`."""
    success = clips.success[:, -1]
    prediction = scenes[""].prediction
    rows, ranks = choose_clips(psnr, success, REPORT_CLIPS)
    arrays: dict[str, Any] = {
        "clip": clips.index[rows],
        "task": np.array(clips.task)[rows],
        "psnr": psnr[rows],
        "rank": ranks,
        "truth": clips.rgb[rows],
        "prediction": prediction.rgb[rows],
        "has_depth": clips.has_depth[rows],
        "metric": clips.metric[rows],
        "true_depth": clips.depth[rows],
        "tracks": clips.tracks[rows],
        "visible": clips.visible[rows],
        "success": success[rows],
    }
    if "other" in scenes[""].alternatives:
        arrays["other_actions"] = scenes[""].alternatives["other"][0].rgb[rows]
    if "_tokenizer" in scenes:
        arrays["reconstruction"] = scenes["_tokenizer"].prediction.rgb[rows]
    if prediction.depth is not None:
        arrays["predicted_depth"] = prediction.depth[rows]
    return arrays


def kept_frames(scenes: Mapping[str, Scene], still: PerClip) -> dict[str, np.ndarray]:
    """Returns the frames of some clips: clips spread evenly, and those with the most and the least motion.

    The choice is the same for all models.

    Args:
        still: PSNR of the last prompt frame repeated, which does not depend on the model.
    """
    truth = scenes[""].truth.rgb
    rows = np.union1d(spread(truth, KEPT_CLIPS), np.concatenate(extremes(still)))
    arrays = {"rows": rows, "truth": truth[rows], "prediction": scenes[""].prediction.rgb[rows]}
    if "_tokenizer" in scenes:
        arrays["reconstruction"] = scenes["_tokenizer"].prediction.rgb[rows]
    return arrays
