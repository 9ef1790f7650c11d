"""Means over clips and their confidence intervals."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

Statistic = Literal["mean", "median"]


@dataclass(frozen=True)
class Estimate:
    """A mean or median over clips with its bootstrap interval; ``low`` and ``high`` are None for a single clip."""

    value: float
    low: float | None
    high: float | None

    def flat(self, name: str) -> dict[str, float]:
        """Returns the value as ``name``, and the interval, if any, as ``name_low`` and ``name_high``."""
        values = {name: self.value, f"{name}_low": self.low, f"{name}_high": self.high}
        return {key: value for key, value in values.items() if value is not None}


def over_predicted_frames(per_frame: Float[np.ndarray, "*B T"], prompt_frames: int = 1) -> Float[np.ndarray, "*B"]:
    """Returns each clip's mean over its predicted frames, those after the first ``prompt_frames``.

    Raises:
        ValueError: no frame is left.
    """
    per_frame = np.asarray(per_frame)
    if per_frame.shape[-1] <= prompt_frames:
        raise ValueError(f"{prompt_frames} of {per_frame.shape[-1]} frames are given; none is left to score")
    return per_frame[..., prompt_frames:].mean(-1)


def bootstrap(
    per_clip: Float[np.ndarray, " B"],
    seed: int = 0,
    level: float = 0.95,
    resamples: int = 10_000,
    statistic: Statistic = "mean",
) -> Estimate:
    """Returns the mean or median over clips and its percentile-bootstrap interval; clips are resampled, not frames.

    For a paired comparison of two models, pass the clips' differences.

    Args:
        per_clip: one finite number per clip.
        seed: of the resampling.
        level: the interval's coverage, between 0 and 1.
        resamples: the number of times that B clips are drawn with replacement.
        statistic: what summarises the clips.

    Raises:
        ValueError: no clips, or a value that is not finite.
    """
    values = np.asarray(per_clip, np.float64)
    if values.ndim != 1 or not values.size or not np.isfinite(values).all():
        raise ValueError(f"an interval needs one finite number per clip, not {values}")
    if len(values) == 1:
        return Estimate(float(values[0]), None, None)
    drawn = np.random.default_rng(seed).integers(len(values), size=(resamples, len(values)))
    tail = (1 - level) / 2
    summarise = np.mean if statistic == "mean" else np.median
    low, high = np.quantile(summarise(values[drawn], axis=1), [tail, 1 - tail])
    return Estimate(float(summarise(values)), float(low), float(high))
