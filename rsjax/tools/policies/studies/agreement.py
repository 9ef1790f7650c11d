"""Measures how well the success rates of policies in one world predict their success rates in another.

Axes: P policies, W world models.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtri, stdtrit

from rsjax.evaluation.statistics import Estimate

MIDDLE = (0.1, 0.9)  # the true rates of policies whose bias is reported by itself


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
        pearson_inner: r without the policies that always fail or always succeed in truth, on which a high r may rest.
        inner: how many policies these are.
        bias_middle: the bias over policies whose true rate is 10 to 90 %; NaN without any.
    """

    pearson: Estimate
    r2_line: float
    r2_identity: float
    r2_prediction: float
    spearman: float
    mmrv: float
    bias: float
    pearson_inner: Estimate
    inner: int
    bias_middle: float


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
    inside = inner(x)
    of_middle = middle(x)
    bias_middle = float("nan")
    if of_middle.any():
        bias_middle = float(np.mean((y - x)[of_middle]))
    return Agreement(
        pearson=fisher(r, len(x), level),
        r2_line=r**2,
        r2_identity=_r2(x, y, y),
        r2_prediction=_r2(x, y, x),
        spearman=correlation(ranks(x), ranks(y)),
        mmrv=rank_violation(x, y),
        bias=float(np.mean(y - x)),
        pearson_inner=fisher(correlation(x[inside], y[inside]), int(inside.sum()), level),
        inner=int(inside.sum()),
        bias_middle=bias_middle,
    )


def inner(true: Float[np.ndarray, " P"]) -> Bool[np.ndarray, " P"]:
    """Returns which policies sometimes fail and sometimes succeed."""
    return (true > 0) & (true < 1)


def middle(true: Float[np.ndarray, " P"]) -> Bool[np.ndarray, " P"]:
    """Returns which policies have a true rate of 10 to 90 %."""
    low, high = MIDDLE
    return (true >= low) & (true <= high)


def over_trainings(
    true: Float[np.ndarray, " P"],
    predicted: Float[np.ndarray, "W P"],
    training: Sequence[str],
    seed: int = 0,
    level: float = 0.95,
    resamples: int = 2000,
) -> Estimate:
    """Returns r, its mean over world models, with an interval for other trainings of policies and world models.

    Policies of one training share what it learned, and all rates in a world model share its mistakes. So trainings are
    resampled, with all their policies and rates, not policies or episodes: each resample draws as many trainings of
    policies and as many world models as there are, with replacement. The standard deviation of Fisher's z over the
    resamples, times √(k / (k - 1)), is the standard error; the interval is that of Student's t with k - 1 degrees of
    freedom, where k is the number of trainings of policies, or of world models if these are fewer but not one.
    (Percentiles are too narrow: in simulations they covered r in 34 to 44 % of the cases with two trainings, and in 59
    to 69 % with three.)

    Args:
        true: the rates in the true world.
        predicted: the rates in each world model. With only one, the interval says nothing about others.
        training: the name of each policy's training.

    Returns:
        The estimate; without an interval if all policies are of one training, or if r is ±1 up to rounding; NaN if
        success does not vary.
    """
    members = np.array([np.equal(training, name) for name in dict.fromkeys(training)], float)
    value = float(np.mean([correlation(true, rates) for rates in predicted]))
    if len(members) < 2 or not abs(value) < 1 - 1e-12:
        return Estimate(value, None, None)
    rng = np.random.default_rng(seed)
    policies = _draws(len(members), resamples, rng) @ members
    worlds = _draws(len(predicted), resamples, rng) / len(predicted)
    by_world = np.stack([correlations(true, rates, policies) for rates in predicted], axis=1)
    drawn = np.clip((worlds * by_world).sum(1), -1 + 1e-12, 1 - 1e-12)
    fewest = min(count for count in (len(members), len(predicted)) if count > 1)
    error = float(np.nanstd(np.arctanh(drawn))) * np.sqrt(fewest / (fewest - 1))
    half = float(stdtrit(fewest - 1, (1 + level) / 2)) * error
    return Estimate(value, float(np.tanh(np.arctanh(value) - half)), float(np.tanh(np.arctanh(value) + half)))


def _draws(count: int, resamples: int, rng: np.random.Generator) -> Float[np.ndarray, "R N"]:
    """Returns how often each of ``count`` things was drawn in each resample."""
    drawn = rng.integers(count, size=(resamples, count))
    return (drawn[:, :, None] == np.arange(count)).sum(1).astype(float)


def _r2(x: Float[np.ndarray, " P"], y: Float[np.ndarray, " P"], of: Float[np.ndarray, " P"]) -> float:
    total = float(np.sum((of - of.mean()) ** 2))
    if total > 1e-12:
        return 1 - float(np.sum((y - x) ** 2)) / total
    return float("nan")


def correlation(x: Float[np.ndarray, " P"], y: Float[np.ndarray, " P"]) -> float:
    """Returns Pearson's r; NaN if x or y does not vary."""
    if not len(x):
        return float("nan")
    return float(correlations(x, y, np.ones((1, len(x))))[0])


def correlations(
    x: Float[np.ndarray, " P"], y: Float[np.ndarray, " P"], weights: Float[np.ndarray, "R P"]
) -> Float[np.ndarray, " R"]:
    """Returns Pearson's r for each row of weights, by which a policy counts; NaN where x or y does not vary."""
    shares = weights / weights.sum(1, keepdims=True)
    a = x - (shares @ x)[:, None]
    b = y - (shares @ y)[:, None]
    size = np.sqrt((shares * a**2).sum(1) * (shares * b**2).sum(1))
    varies = size > 1e-12
    r = np.clip((shares * a * b).sum(1) / np.where(varies, size, 1), -1, 1)
    return np.where(varies, r, np.nan)


def fisher(r: float, count: int, level: float = 0.95) -> Estimate:
    """Returns r with the interval of Fisher's z transform; there is none if r is ±1 up to rounding, or count < 4."""
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
