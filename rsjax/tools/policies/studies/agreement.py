"""Measures how well the success rates of policies in one world predict their success rates in another.

Axes: P policies.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rsjax.evaluation.statistics import Estimate


@dataclass(frozen=True)
class Agreement:
    """The agreement of predicted success rates y with true ones x, over policies.

    Attributes:
        pearson: r with its Fisher interval (None with fewer than 4 policies, or if all lie on a line).
        r2_line: R² of the line that fits best, which is r².
        r2_identity: R² of the line y = x, 1 - Σ(y - x)² / Σ(y - ȳ)². It is relative to the spread of y, as ``r2_line``
            is.
        r2_prediction: R² of y as a prediction of x, 1 - Σ(y - x)² / Σ(x - x̄)². If the spreads of x and y differ, one
            of ``r2_identity`` and ``r2_prediction`` may be above 0 (better than the mean) and the other below.
        spearman: the correlation of the ranks.
        mmrv: mean maximum rank violation (SIMPLER): how much the true success rates of wrongly ordered policies differ.
        bias: the mean of predicted - true.
    """

    pearson: Estimate
    r2_line: float
    r2_identity: float
    r2_prediction: float
    spearman: float
    mmrv: float
    bias: float


def agreement(true: Float[np.ndarray, " P"], predicted: Float[np.ndarray, " P"], level: float = 0.95) -> Agreement:
    """Compares success rates. Correlations are NaN if x or y does not vary; R² is NaN if its denominator is 0.

    Raises:
        ValueError: there are fewer than 2 policies, or the two arrays differ in length.
    """
    x = np.asarray(true, np.float64)
    y = np.asarray(predicted, np.float64)
    if x.shape != y.shape or x.ndim != 1 or len(x) < 2:
        raise ValueError(f"agreement needs the same two policies or more in both, not {x.shape} and {y.shape}")
    r = correlation(x, y)
    return Agreement(
        pearson=fisher(r, len(x), level),
        r2_line=r**2,
        r2_identity=_r2(x, y, y),
        r2_prediction=_r2(x, y, x),
        spearman=correlation(ranks(x), ranks(y)),
        mmrv=rank_violation(x, y),
        bias=float(np.mean(y - x)),
    )


def _r2(x: Float[np.ndarray, " P"], y: Float[np.ndarray, " P"], of: Float[np.ndarray, " P"]) -> float:
    total = float(np.sum((of - of.mean()) ** 2))
    if total > 1e-12:
        return 1 - float(np.sum((y - x) ** 2)) / total
    return float("nan")


def correlation(x: Float[np.ndarray, " P"], y: Float[np.ndarray, " P"]) -> float:
    """Returns Pearson's r; NaN if x or y does not vary."""
    a = x - x.mean()
    b = y - y.mean()
    size = float(np.sqrt(np.sum(a**2) * np.sum(b**2)))
    if size > 1e-12:
        return float(np.clip(np.sum(a * b) / size, -1, 1))
    return float("nan")


def fisher(r: float, count: int, level: float = 0.95) -> Estimate:
    """Returns r with the interval of Fisher's z transform; there is none if r is ±1 up to rounding, or count < 4."""
    from scipy.special import ndtri

    if count < 4 or not abs(r) < 1 - 1e-12:
        return Estimate(r, None, None)
    half = float(ndtri((1 + level) / 2)) / np.sqrt(count - 3)
    return Estimate(r, float(np.tanh(np.arctanh(r) - half)), float(np.tanh(np.arctanh(r) + half)))


def ranks(values: Float[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
    """Returns ranks from 1; equal values share the mean of their ranks."""
    below = (values[:, None] > values).sum(1)
    return below + (1 + (values[:, None] == values).sum(1)) / 2


def rank_violation(true: Float[np.ndarray, " P"], predicted: Float[np.ndarray, " P"]) -> float:
    """Returns the mean over policies of the largest true difference to a policy that is ranked in the wrong order."""
    apart = np.abs(true[:, None] - true)
    wrong = (true[:, None] < true) != (predicted[:, None] < predicted)
    return float(np.mean(np.max(apart * wrong, axis=1)))
