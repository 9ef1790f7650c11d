"""AbsRel and δ_k of predicted depth against true depth, under the alignments that published work uses.

Depth is z-depth along the optical axis. A prediction in metres (a depth branch trained on a simulator's depth) needs
no alignment; a monocular estimator's output is known up to a scale, or a scale and a shift, and is fitted to the truth
once per video.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

Alignment = Literal["none", "median", "affine_disparity", "l1_scale"]
DepthSource = Literal["branch", "estimator"]

_MIN_PREDICTION = 1e-3
_L1_STEPS = 10
_MIN_L1_SCALE = 1e-3


@dataclass(frozen=True)
class Protocol:
    """Which pixels count and how they are averaged.

    Attributes:
        min_truth: true depth must exceed this (strictly).
        max_truth: true depth must lie below this (strictly) unless the caller says otherwise.
        averaging: "frame": pixels → frame → video → data set; "video": pixels of a video → data set;
            "pixel": all pixels of the data set count alike.
    """

    min_truth: float
    max_truth: float
    averaging: Literal["frame", "video", "pixel"]


PROTOCOLS: dict[Alignment, Protocol] = {
    "none": Protocol(0.0, np.inf, "video"),
    "median": Protocol(1e-3, np.inf, "video"),  # WorldArena 2026
    "affine_disparity": Protocol(1e-3, np.inf, "frame"),  # Video Depth Anything
    "l1_scale": Protocol(0.0, 70.0, "pixel"),  # Aether, CUT3R
}


@dataclass(frozen=True)
class DepthScores:
    """Scores of B videos.

    Attributes:
        abs_rel: mean of |d̂ - d| / d, per video.
        delta1: share of pixels with max(d̂/d, d/d̂) < 1.25 (strict), per video, 0–1.
        delta2: the same with 1.25².
        weight: what each video counts for in the data set's mean: 1, or its pixels where all are pooled.
    """

    abs_rel: Float[np.ndarray, " B"]
    delta1: Float[np.ndarray, " B"]
    delta2: Float[np.ndarray, " B"]
    weight: Float[np.ndarray, " B"]

    def mean(self) -> dict[str, float]:
        """The data set's scores, by the names that :func:`result_key` takes."""
        values = {"absrel": self.abs_rel, "delta1": self.delta1, "delta2": self.delta2}
        return {name: float(np.average(value, weights=self.weight)) for name, value in values.items()}


def abs_rel(truth: Float[np.ndarray, "..."], prediction: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """|d̂ - d| / d of each pixel; depths > 0."""
    return np.abs(prediction - truth) / truth


def within(truth: Float[np.ndarray, "..."], prediction: Float[np.ndarray, "..."], k: int) -> Bool[np.ndarray, "..."]:
    """δ_k of each pixel: max(d̂/d, d/d̂) strictly below 1.25^k; depths > 0."""
    return np.maximum(prediction / truth, truth / prediction) < 1.25**k


def align(
    truth: Float[np.ndarray, "T H W"],
    prediction: Float[np.ndarray, "T H W"],
    mask: Bool[np.ndarray, "T H W"],
    alignment: Alignment,
) -> Float[np.ndarray, "T H W"]:
    """The prediction brought to the truth's scale by one fit over the video's masked pixels, in float64.

    "none": as it is. "median": times median(d) / median(d̂). "affine_disparity": a/d̂ + b fitted to 1/d by least
    squares, disparities kept ≥ 1e-3. "l1_scale": times s, the minimiser of Σ|s·d̂ - d|, from 10
    reweighted least-squares steps that start at mean(d) / mean(d̂); s ≥ 1e-3.

    """
    d, p = truth[mask].astype(np.float64), prediction[mask].astype(np.float64)
    full = prediction.astype(np.float64)
    match alignment:
        case "none":
            return full
        case "median":
            return full * (np.median(d) / np.median(p))
        case "affine_disparity":
            columns = np.stack([1 / np.maximum(p, _MIN_PREDICTION), np.ones_like(p)], axis=1)
            scale, shift = np.linalg.lstsq(columns, 1 / d, rcond=None)[0]
            disparity = scale / np.maximum(full, _MIN_PREDICTION) + shift
            return 1 / np.maximum(disparity, 1e-3)
        case "l1_scale":
            return full * _l1_scale(d, p)


def _l1_scale(d: Float[np.ndarray, " N"], p: Float[np.ndarray, " N"]) -> float:
    scale = d.mean() / p.mean()
    for _ in range(_L1_STEPS):
        weight = 1 / (np.abs(scale * p - d) + 1e-8)
        scale = (weight * p * d).sum() / (weight * p * p).sum()
    return max(float(scale), _MIN_L1_SCALE)


def depth_scores(
    truth: Float[np.ndarray, "B T H W"],
    prediction: Float[np.ndarray, "B T H W"],
    alignment: Alignment = "median",
    max_depth: float | None = None,
) -> DepthScores:
    """AbsRel, δ1 and δ2 of each of B videos under one protocol of :data:`PROTOCOLS`.

    Leave the given frames out before calling. Aligned predictions below 1e-3 are raised to it, and capped at
    ``max_depth`` where one is given.

    Args:
        truth: metres; pixels without a depth are 0 or not finite and don't count.
        prediction: metres, or whatever unit the alignment fits away; finite.
        alignment: how the prediction is fitted to the truth.
        max_depth: true depths must lie below this (strictly); None takes the protocol's own bound.

    Raises:
        ValueError: shapes differ, the alignment is unknown, the prediction is not finite, or a video (or a frame,
            where frames are averaged) has no valid pixel.
    """
    if truth.shape != prediction.shape or truth.ndim != 4:
        raise ValueError(f"depth has shapes {truth.shape} and {prediction.shape}; both must be the same [B, T, H, W]")
    if not np.isfinite(prediction).all():
        raise ValueError("predicted depth has values that are not finite")
    if alignment not in PROTOCOLS:
        raise ValueError(f"unknown depth alignment {alignment!r}; one of {', '.join(PROTOCOLS)}")
    protocol = PROTOCOLS[alignment]
    upper = protocol.max_truth if max_depth is None else max_depth
    mask = np.isfinite(truth) & (truth > protocol.min_truth) & (truth < upper)
    counted = mask.any(axis=(2, 3) if protocol.averaging == "frame" else (1, 2, 3))
    if not counted.all():
        raise ValueError(
            f"true depth of video {np.argwhere(~counted)[0][0]} has no pixel (or a frame without one) "
            f"between {protocol.min_truth} and {upper} metres"
        )
    rows = [
        _video_scores(d, np.clip(align(d, p, m, alignment), _MIN_PREDICTION, upper), m, protocol)
        for d, p, m in zip(truth, prediction, mask, strict=True)
    ]
    absolute, first, second = np.array(rows).T
    pooled = protocol.averaging == "pixel"
    weight = mask.sum((1, 2, 3)).astype(np.float64) if pooled else np.ones(len(truth))
    return DepthScores(absolute, first, second, weight)


def _video_scores(
    truth: Float[np.ndarray, "T H W"],
    prediction: Float[np.ndarray, "T H W"],
    mask: Bool[np.ndarray, "T H W"],
    protocol: Protocol,
) -> list[float]:
    truth = np.where(mask, truth, 1.0)
    per_pixel = [abs_rel(truth, prediction), within(truth, prediction, 1), within(truth, prediction, 2)]
    axes = (1, 2) if protocol.averaging == "frame" else None
    return [float(np.mean(np.mean(pixels, axis=axes, where=mask))) for pixels in per_pixel]


def result_key(metric: str, alignment: Alignment = "none", source: DepthSource = "branch") -> str:
    """The name under which a depth score is published, so that no two protocols can be confused.

    ``depth_absrel`` is the depth branch in metres, unaligned; anything else carries its alignment and its source:
    ``depth_absrel_median_estimator``.
    """
    plain = alignment == "none" and source == "branch"
    return f"depth_{metric}" if plain else f"depth_{metric}_{alignment}_{source}"
