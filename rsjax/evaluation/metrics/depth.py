"""AbsRel and δ_k of predicted depth, under the alignments that published work uses.

Depth is z-depth along the optical axis. Depth of a model trained on metres needs no alignment. A monocular estimator's
output is known only up to a scale, or a scale and a shift, which are fitted to the truth once per video.
"""

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float

from rsjax.evaluation.registry import PerClip, PerFrame, Scene, Scores, Unavailable, metric

Alignment = Literal["none", "median", "affine_disparity", "l1_scale"]
DepthSource = Literal["branch", "estimator"]
Measure = Literal["absrel", "delta1", "delta2"]
Depths: TypeAlias = Float[np.ndarray, "B T H W"]

# Title, better values and decimals of each score.
_MEASURES: dict[Measure, tuple[str, Literal["higher", "lower"], int]] = {
    "absrel": ("depth AbsRel", "lower", 4),
    "delta1": ("depth δ₁", "higher", 3),
    "delta2": ("depth δ₂", "higher", 3),
}

_NO_ESTIMATOR = "no estimator: --eval.depth-estimator simulator, or NETWORK:FIELD=PATH (docs/evaluation.md)"
_MIN_PREDICTION = 1e-3
_L1_STEPS = 10
_MIN_L1_SCALE = 1e-3


@dataclass(frozen=True)
class DepthProtocol:
    """A rule for which pixels count and how they are averaged.

    Attributes:
        min_truth: only pixels with a true depth strictly above this count.
        max_truth: only pixels with a true depth strictly below this count, unless the caller sets another bound.
        averaging: "frame": over pixels, then frames, then videos; "video": over the pixels of a video, then videos;
            "pixel": all pixels of the data set have the same weight.
    """

    min_truth: float
    max_truth: float
    averaging: Literal["frame", "video", "pixel"]


PROTOCOLS: dict[Alignment, DepthProtocol] = {
    "none": DepthProtocol(0.0, np.inf, "video"),
    "median": DepthProtocol(1e-3, np.inf, "video"),  # WorldArena 2026
    "affine_disparity": DepthProtocol(1e-3, np.inf, "frame"),  # Video Depth Anything
    "l1_scale": DepthProtocol(0.0, 70.0, "pixel"),  # Aether, CUT3R
}


@dataclass(frozen=True)
class DepthScores:
    """Scores of B videos.

    Attributes:
        abs_rel: each video's mean of |d̂ - d| / d.
        delta1: each video's share of pixels with max(d̂/d, d/d̂) < 1.25, 0–1.
        delta2: as delta1, but with 1.25².
        weight: each video's weight in the data set's mean: 1, or its number of pixels for averaging "pixel".
        frames: abs_rel, delta1 and delta2 of each frame's valid pixels; NaN for a frame without any.
    """

    abs_rel: Float[np.ndarray, " B"]
    delta1: Float[np.ndarray, " B"]
    delta2: Float[np.ndarray, " B"]
    weight: Float[np.ndarray, " B"]
    frames: Float[np.ndarray, "3 B T"]

    def per_clip(self, measure: Measure) -> Float[np.ndarray, " B"]:
        """Returns each video's score, such that their plain mean is the data set's score."""
        scores = {"absrel": self.abs_rel, "delta1": self.delta1, "delta2": self.delta2}[measure]
        return scores * (self.weight / self.weight.mean())

    def per_frame(self, measure: Measure) -> PerFrame:
        """Returns each frame's score."""
        return self.frames[get_args(Measure).index(measure)]


def _register(measure: Measure, alignment: Alignment, source: DepthSource) -> None:
    """Registers one score under one protocol; tables have columns for metres and for WorldArena's protocol."""
    title, better, decimals = _MEASURES[measure]
    plain = result_key(measure, alignment, source) == f"depth_{measure}"

    def per_frame(scene: Scene) -> PerFrame:
        return scene.shared(_scores, alignment, source).per_frame(measure)

    @metric(
        result_key(measure, alignment, source),
        title if plain else f"{title}, {source}, {alignment.replace('_', ' ')}",
        better=better,
        decimals=decimals,
        watch=plain and measure == "absrel",
        interval=measure == "absrel",
        column=plain or (alignment, source) == ("median", "estimator"),
        per_frame=per_frame,
    )
    def score(scene: Scene) -> PerClip:
        return scene.shared(_scores, alignment, source).per_clip(measure)


def _register_exact(measure: Measure) -> None:
    """Registers one score of estimated depth against exact depth; ``…_truth`` is the estimator's own error."""
    title, better, decimals = _MEASURES[measure]

    def per_frame(scene: Scene) -> PerFrame:
        return scene.shared(_exact_scores)[""].per_frame(measure)

    @metric(
        f"depth_{measure}_exact_estimator",
        f"{title}, estimator, exact",
        better=better,
        decimals=decimals,
        interval=measure == "absrel",
        column=False,
        per_frame=per_frame,
    )
    def score(scene: Scene) -> Scores:
        return {part: scores.per_clip(measure) for part, scores in scene.shared(_exact_scores).items()}


def _exact_scores(scene: Scene) -> dict[str, DepthScores]:
    """Scores the depth estimated from generated frames against the recorded depth, both in metres.

    Returns:
        The scores by part of the metric's name; "_truth", the estimator's own error on recorded frames, only once.
    """
    estimated = scene.estimated
    if estimated is None:
        raise Unavailable(_NO_ESTIMATOR)
    if not estimated.metres:
        raise Unavailable("the estimator's depth is not in metres")
    rows = scene.truth.has_depth
    if scene.truth.depth is None or not rows.any():
        raise Unavailable("no test clip has depth in metres")
    exact = scene.truth.depth[rows, scene.prompt_frames :]
    videos = {"": estimated.prediction}
    if not estimated.baseline:
        videos["_truth"] = estimated.truth
    try:
        return {part: depth_scores(exact, each[rows, scene.prompt_frames :], "none") for part, each in videos.items()}
    except ValueError as error:
        raise Unavailable(str(error)) from error


def _scores(scene: Scene, alignment: Alignment, source: DepthSource) -> DepthScores:
    if source == "branch":
        rows = scene.truth.has_depth
        if scene.truth.depth is None or not rows.any():
            raise Unavailable("no test clip has depth in metres")
        if scene.prediction.depth is None:
            raise Unavailable("the model generates no depth")
        truth = scene.truth.depth[rows]
        predicted = scene.prediction.depth[rows]
    else:
        if scene.estimated is None:
            raise Unavailable(_NO_ESTIMATOR)
        truth = scene.estimated.truth
        predicted = scene.estimated.prediction
    first = scene.prompt_frames
    try:
        return depth_scores(truth[:, first:], predicted[:, first:], alignment)
    except ValueError as error:
        raise Unavailable(str(error)) from error


def abs_rel(truth: Float[np.ndarray, "..."], prediction: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Returns |d̂ - d| / d of each pixel; depths > 0."""
    return np.abs(prediction - truth) / truth


def within(truth: Float[np.ndarray, "..."], prediction: Float[np.ndarray, "..."], k: int) -> Bool[np.ndarray, "..."]:
    """Returns δ_k of each pixel: whether max(d̂/d, d/d̂) < 1.25^k; depths > 0."""
    return np.maximum(prediction / truth, truth / prediction) < 1.25**k


def align(
    truth: Float[np.ndarray, "T H W"],
    prediction: Float[np.ndarray, "T H W"],
    mask: Bool[np.ndarray, "T H W"],
    alignment: Alignment,
) -> Float[np.ndarray, "T H W"]:
    """Aligns the prediction with the truth by one fit over the video's masked pixels, in float64.

    "none": unchanged. "median": multiplied by median(d) / median(d̂). "affine_disparity": a/d̂ + b is fitted to 1/d by
    least squares, and disparities are kept ≥ 1e-3. "l1_scale": multiplied by s, the minimiser of Σ|s·d̂ - d|, found by
    10 reweighted least-squares steps that start at mean(d) / mean(d̂); s ≥ 1e-3.
    """
    d = truth[mask].astype(np.float64)
    p = prediction[mask].astype(np.float64)
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
            scale = d.mean() / p.mean()
            for _ in range(_L1_STEPS):
                weight = 1 / (np.abs(scale * p - d) + 1e-8)
                scale = (weight * p * d).sum() / (weight * p * p).sum()
            return full * max(float(scale), _MIN_L1_SCALE)


def depth_scores(
    truth: Float[np.ndarray, "B T H W"],
    prediction: Float[np.ndarray, "B T H W"],
    alignment: Alignment = "median",
    max_depth: float | None = None,
) -> DepthScores:
    """Scores AbsRel, δ₁ and δ₂ of each of B videos under one protocol of :data:`PROTOCOLS`.

    Pass predicted frames only. Aligned predictions are clipped to 1e-3 … the upper bound of true depths.

    Args:
        truth: metres; pixels that are 0 or not finite have no depth and do not count.
        prediction: finite; metres, or any unit if it is aligned.
        alignment: how to align the prediction with the truth.
        max_depth: only pixels with a true depth strictly below this count; None: the protocol's ``max_truth``.

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
    axes = (1, 2) if protocol.averaging == "frame" else None
    videos = []
    frames = []
    for d, p, m in zip(truth, prediction, mask, strict=True):
        aligned = np.clip(align(d, p, m, alignment), _MIN_PREDICTION, upper)
        d = np.where(m, d, 1.0)
        per_pixel = [abs_rel(d, aligned), within(d, aligned, 1), within(d, aligned, 2)]
        videos.append([float(np.mean(np.mean(pixels, axis=axes, where=m))) for pixels in per_pixel])
        valid = m.sum((1, 2))
        sums = np.stack([np.sum(pixels, axis=(1, 2), where=m) for pixels in per_pixel])
        frames.append(np.where(valid, sums / np.maximum(valid, 1), np.nan))
    absolute, first, second = np.array(videos).T
    pooled = protocol.averaging == "pixel"
    weight = mask.sum((1, 2, 3)).astype(np.float64) if pooled else np.ones(len(truth))
    return DepthScores(absolute, first, second, weight, np.stack(frames, axis=1))


def result_key(metric: str, alignment: Alignment = "none", source: DepthSource = "branch") -> str:
    """Returns the name of a depth score in results, which is different for each protocol.

    ``depth_absrel`` is the score of the predicted depth in metres, unaligned; all other names contain the alignment and
    the source, such as ``depth_absrel_median_estimator``.
    """
    plain = alignment == "none" and source == "branch"
    return f"depth_{metric}" if plain else f"depth_{metric}_{alignment}_{source}"


for _measure in get_args(Measure):
    _register(_measure, "none", "branch")
    _register_exact(_measure)
for _source in get_args(DepthSource):
    for _alignment in ("median", "affine_disparity", "l1_scale"):
        for _measure in get_args(Measure):
            _register(_measure, _alignment, _source)
