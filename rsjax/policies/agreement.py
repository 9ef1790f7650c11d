"""How well success in one world predicts success in another, over policies.

Axes: P policies.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rsjax.evaluation.statistics import Estimate


@dataclass(frozen=True)
class Agreement:
    """Agreement of predicted and true success rates over policies.

    Attributes:
        pearson: r with its Fisher interval (None with fewer than 4 policies).
        r2_line: R² of the line that fits best, which is r².
        r2_identity: R² of the predictions themselves, 1 - SS_res / SS_tot; below 0 for worse than the mean.
        spearman: the correlation of the ranks.
        mmrv: mean maximum rank violation (SIMPLER): how far apart, in truth, policies are that are ranked wrongly.
        bias: mean of predicted - true.
    """

    pearson: Estimate
    r2_line: float
    r2_identity: float
    spearman: float
    mmrv: float
    bias: float


def agreement(true: Float[np.ndarray, " P"], predicted: Float[np.ndarray, " P"], level: float = 0.95) -> Agreement:
    """Compares success rates. Correlations are NaN where either does not vary.

    Raises:
        ValueError: fewer than 2 policies, or other numbers of them.
    """
    x, y = np.asarray(true, np.float64), np.asarray(predicted, np.float64)
    if x.shape != y.shape or x.ndim != 1 or len(x) < 2:
        raise ValueError(f"agreement needs the same two policies or more in both, not {x.shape} and {y.shape}")
    r, total = correlation(x, y), float(np.sum((x - x.mean()) ** 2))
    identity = 1 - float(np.sum((x - y) ** 2)) / total if total else float("nan")
    return Agreement(
        pearson=fisher(r, len(x), level),
        r2_line=r**2,
        r2_identity=identity,
        spearman=correlation(ranks(x), ranks(y)),
        mmrv=rank_violation(x, y),
        bias=float(np.mean(y - x)),
    )


def correlation(x: Float[np.ndarray, " P"], y: Float[np.ndarray, " P"]) -> float:
    """Returns Pearson's r; NaN where one does not vary."""
    a, b = x - x.mean(), y - y.mean()
    size = float(np.sqrt(np.sum(a**2) * np.sum(b**2)))
    return float(np.sum(a * b)) / size if size > 1e-12 else float("nan")


def fisher(r: float, count: int, level: float = 0.95) -> Estimate:
    """Returns r with the interval of Fisher's z transform."""
    from scipy.special import ndtri

    if count < 4 or not abs(r) < 1:
        return Estimate(r, None, None)
    half = float(ndtri((1 + level) / 2)) / np.sqrt(count - 3)
    return Estimate(r, float(np.tanh(np.arctanh(r) - half)), float(np.tanh(np.arctanh(r) + half)))


def ranks(values: Float[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
    """Returns ranks from 1; equal values share the mean of theirs."""
    below = (values[:, None] > values).sum(1)
    return below + (1 + (values[:, None] == values).sum(1)) / 2


def rank_violation(true: Float[np.ndarray, " P"], predicted: Float[np.ndarray, " P"]) -> float:
    """Returns the mean over policies of the largest true difference to one that is ranked the other way round."""
    apart = np.abs(true[:, None] - true)
    wrong = (true[:, None] < true) != (predicted[:, None] < predicted)
    return float(np.mean(np.max(apart * wrong, axis=1)))
