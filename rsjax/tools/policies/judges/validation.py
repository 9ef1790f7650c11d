"""Measures how far a judge can be trusted: its confusion matrix and calibration on held-out videos of three kinds.

The kinds are raw frames, the tokenizer's reconstructions, and videos generated under the clips' own actions. The labels
are always the simulator's. On generated videos the model's errors count as the judge's errors: if the model drops a
cube that was lifted in the clip, a correct judge says "fail" but the label is "success".
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from rsjax.evaluation.statistics import wilson
from rsjax.tools.policies.judges.judge import (
    FAIL,
    LABELS,
    SUCCESS,
    UNINTERPRETABLE,
    Judge,
    all_successes,
    frames_of,
    of_single_frames,
)
from rsjax.tools.policies.judges.trained_judge import VALIDATED, Footage, corrupted
from rsjax.tools.studies.tables import ABSENT, Table, as_markdown

KINDS = VALIDATED
OUTCOMES = ("false_success", "false_failure", "right")
BINS = 10
AT_ONCE = 1024  # histories judged at once


def validate(judge: Judge, footage: Footage, first: int = 1, corrupt: bool = False) -> dict[str, Any]:
    """Judges every frame from ``first`` on, and returns counts and rates, ready for JSON.

    Args:
        corrupt: whether to judge also an equal number of corrupted histories, whose label is "uninterpretable".
    """
    videos, frames = (each.ravel() for each in np.indices(footage.success.shape)[:, :, first:])
    truth = np.where(footage.success[videos, frames], SUCCESS, FAIL)
    rng = np.random.default_rng(0)

    def verdicts(judge: Judge, corrupt: bool = False) -> Float[np.ndarray, "N 3"]:
        parts = []
        for start in range(0, len(videos), AT_ONCE):
            rows = slice(start, start + AT_ONCE)
            history = footage.histories(videos[rows], frames[rows], frames_of(judge))
            if corrupt:
                history = corrupted(history, np.roll(history, len(history) // 2, axis=0), rng)
            parts.append(judge(history))
        return np.concatenate(parts)

    probabilities = verdicts(judge)
    labels = truth
    single = probabilities
    if corrupt:
        probabilities = np.concatenate([probabilities, verdicts(judge, corrupt=True)])
        labels = np.concatenate([truth, np.full(len(truth), UNINTERPRETABLE)])
    if of_single_frames(judge) is not judge:
        single = verdicts(of_single_frames(judge))
    by_frame = single.reshape(len(footage.success), -1, len(LABELS)).swapaxes(0, 1)
    return scores(probabilities, labels) | {"whole_clips": outcomes(by_frame, footage.success[:, first:])}


def outcomes(
    verdicts: Float[np.ndarray, "T N 3"], success: Bool[np.ndarray, "N T"], in_a_row: Sequence[int] = (1, 2)
) -> dict[str, dict[str, list[float | None]]]:
    """Returns how whole clips are judged if one frame, or several in a row, must show success, ready for JSON.

    A clip succeeds if one of its frames does: an episode in a world ends there.

    Args:
        verdicts: of single frames.
        success: the simulator's, of the same frames.

    Returns:
        By number of frames: the share of clips called a success among those that fail (``false_success``), the share
        not called one among those that succeed (``false_failure``), and the share that is ``right``, each with its
        Wilson interval.
    """
    truth = np.asarray(success.any(axis=1))
    by_count: dict[str, dict[str, list[float | None]]] = {}
    for count in in_a_row:
        each = [all_successes(verdicts[max(0, t - count + 1) : t + 1]) for t in range(len(verdicts))]
        called = (np.stack(each).argmax(-1) == SUCCESS).any(axis=0)
        counts = {
            "false_success": (int((called & ~truth).sum()), int((~truth).sum())),
            "false_failure": (int((~called & truth).sum()), int(truth.sum())),
            "right": (int((called == truth).sum()), len(truth)),
        }
        rates = {name: wilson(*pair) for name, pair in counts.items() if pair[1]}
        by_count[str(count)] = {name: [rate.value, rate.low, rate.high] for name, rate in rates.items()}
    return by_count


def scores(probabilities: Float[np.ndarray, "N 3"], truth: Int[np.ndarray, " N"]) -> dict[str, Any]:
    """Returns the confusion matrix (rows: the truth), rates with Wilson intervals, and the calibration.

    ``calibration_error`` is the expected calibration error (ECE): the mean gap between the highest probability and the
    share of correct labels, over ten equal bins of that probability, weighted by the bins' counts. ``brier`` is the
    mean squared error of the probabilities. Frames of one clip resemble each other, so the intervals, which count
    frames as independent, are narrower than they should be.
    """
    chosen = probabilities.argmax(-1)
    sure = probabilities.max(-1)
    right = chosen == truth
    matrix = np.zeros((len(LABELS), len(LABELS)), int)
    np.add.at(matrix, (truth, chosen), 1)
    place = np.minimum((sure * BINS).astype(int), BINS - 1)
    bins = [
        {"confidence": float(sure[place == i].mean()), "right": float(right[place == i].mean()), "frames": int(count)}
        for i, count in enumerate(np.bincount(place, minlength=BINS))
        if count
    ]
    rates = {f"{LABELS[i]}_found": (int(row[i]), int(row.sum())) for i, row in enumerate(matrix) if row.sum()}
    rates["right"] = (int(right.sum()), len(right))
    intervals = {name: wilson(*counts) for name, counts in rates.items()}
    error = sum(each["frames"] * abs(each["confidence"] - each["right"]) for each in bins) / len(right)
    return {
        "labels": list(LABELS),
        "confusion": matrix.tolist(),
        **{name: [rate.value, rate.low, rate.high] for name, rate in intervals.items()},
        "uninterpretable_share": float((chosen == UNINTERPRETABLE).mean()),
        "calibration_error": error,
        "brier": float(np.square(probabilities - np.eye(len(LABELS))[truth]).sum(-1).mean()),
        "bins": bins,
    }


def summary(validation: dict[str, Any] | None) -> dict[str, Any] | None:
    """Returns the part of a validation that results contain: for each kind of video, everything but the bins."""
    if validation is None:
        return None
    kinds = {kind: validation[kind] for kind in KINDS if kind in validation}
    return {kind: {name: part[name] for name in part if name != "bins"} for kind, part in kinds.items()}


def markdown(judge: dict[str, Any] | None) -> list[str]:
    """Returns a :func:`summary` as parts of a Markdown text: confusion matrix and calibration by kind of video."""
    if judge is None:
        return ["", "The judge has no validation.json: how far it can be trusted is unknown."]
    labels = " / ".join(LABELS)
    rows = []
    for kind, part in judge.items():
        counts = [" / ".join(map(str, row)) if any(row) else ABSENT for row in part["confusion"]]
        rows.append([kind, *counts, f"{100 * part['right'][0]:.1f} %", f"{part['calibration_error']:.3f}"])
    kinds = as_markdown(Table(("video", *LABELS, "right", "calibration error"), rows))
    lines = ["", f"The judge on held-out clips (frames called {labels}, by what they are):", "", kinds]
    if whole := whole_clips(judge):
        lines += ["", "Whole clips, by how many frames in a row must show success:", "", as_markdown(whole)]
    return lines


def whole_clips(result: dict[str, Any]) -> Table | None:
    """Returns the :func:`outcomes` of a validation as a table; None for a judge of whole videos."""
    rows = []
    for kind in KINDS:
        for count, rates in result.get(kind, {}).get("whole_clips", {}).items():
            shares = [f"{100 * rates[name][0]:.1f} %" if name in rates else ABSENT for name in OUTCOMES]
            rows.append([kind, count, *shares])
    if not rows:
        return None
    return Table(("video", "frames", *(name.replace("_", " ") for name in OUTCOMES)), rows)


def confusion_table(result: dict[str, Any]) -> Table:
    """Returns a validation as a table: a row for each kind of video and true label."""
    rows = []
    for kind in KINDS:
        part = result.get(kind)
        for i, row in enumerate(part["confusion"] if part else ()):
            if any(row):
                share = f"{row[i] / sum(row):.1%}"
                error = f"{part['calibration_error']:.3f}" if i == 0 else ""  # type: ignore[index]
                rows.append([kind, LABELS[i], *map(str, row), share, error])
    return Table(("video", "truth", *LABELS, "right", "calibration error"), rows)
