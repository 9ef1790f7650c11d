"""Success rates by prediction-powered inference: many trials in a model, corrected by a few paired with true ones.

There are n paired trials, each run in the true world (Y, 1: success) and in the model (f) from the same start, and N
more in the model alone; M = n + N. The estimate is the mean of f over all M trials, plus the mean of Y - f over the
paired ones, where f is weighted by λ:

    rate(λ) = λ · mean_M f + mean_n (Y - λ f)

- It is unbiased for every fixed λ, however wrong the model is (Angelopoulos et al., "Prediction-Powered Inference",
  Science 2023). λ = 1 trusts the model most; λ = 0 is the mean of the true trials alone.
- PPI++ (Angelopoulos et al., arXiv 2311.01453) chooses the λ of least variance. It averages f over the N other trials,
  which is this estimate with its weight ω = λ N / M. Its best ω = Cov(Y, f) / ((1 + n / N) Var f) is our
  λ = Cov(Y, f) / Var f, the slope of Y over f, and then the variance is (1 - ρ² N / M) Var(Y) / n, where ρ is their
  correlation.
- SureSim (Badithela et al., arXiv 2510.04354) evaluates robot policies so, in simulators. Its intervals hold for any
  number of trials and are wider; ours is Wilson's, with the effective number of trials. Coverage is simulated in
  tests/evaluation/test_prediction_powered.py.

Axes: n paired trials, N other trials.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rsjax.evaluation.statistics import Estimate, score_interval

DISAGREEMENTS = 0.5  # added to each of the two counts of paired trials whose outcomes differ: few trials may all agree


@dataclass(frozen=True)
class CorrectedRate:
    """A success rate in the true world, from paired trials and further trials in a model.

    Attributes:
        rate: the rate with its interval, cut to 0 to 1.
        weight: λ.
        variance: of the rate.
        trials: n, the trials in the true world.
        worth: how many trials in the true world alone would give an interval as narrow.
    """

    rate: Estimate
    weight: float
    variance: float
    trials: int
    worth: float

    @property
    def saved(self) -> float:
        """The trials in the true world that the model saves; below 0 if a fixed weight makes the interval wider."""
        return self.worth - self.trials


def corrected_rate(
    true: ArrayLike, paired: ArrayLike, others: ArrayLike = (), weight: float | None = None, level: float = 0.95
) -> CorrectedRate:
    """Estimates the success rate in the true world.

    Args:
        true: n outcomes in the true world, 1 for a success and 0 for a failure.
        paired: the n outcomes in the model from the same starts, in the same order.
        others: N outcomes in the model from other starts of the same kind.
        weight: λ; None: the one of least variance, from 0 to 1, as estimated from the paired trials.
        level: the interval's coverage.

    Returns:
        The rate. Where the paired outcomes of one world are all alike, they do not show whether the model is right, so
        λ is 0 and no trial is saved.

    Raises:
        ValueError: there is no paired trial, or the numbers of paired outcomes differ.
    """
    y = np.asarray(true, np.float64)
    f = np.asarray(paired, np.float64)
    rest = np.asarray(others, np.float64)
    if y.shape != f.shape or y.ndim != 1 or not len(y):
        raise ValueError(f"paired trials need the same number of outcomes in both worlds, not {y.shape} and {f.shape}")
    n = len(y)
    share = len(rest) / (n + len(rest))
    count = n + 2 * DISAGREEMENTS
    both = float(np.sum(y * f)) / count
    mean_y = (float(y.sum()) + DISAGREEMENTS) / count
    mean_f = (float(f.sum()) + DISAGREEMENTS) / count
    var_y = mean_y * (1 - mean_y)
    var_f = mean_f * (1 - mean_f)
    cov = both - mean_y * mean_f
    if weight is None:
        weight = float(np.clip(cov / var_f, 0, 1))
        if min(np.ptp(y), np.ptp(f)) == 0:
            weight = 0.0
    # Var(rate) · n = Var(Y) - 2 ω Cov(Y, f) + ω² Var(f) (1 + n / N), with ω = λ N / M
    spread = var_y - 2 * weight * share * cov + weight**2 * share * var_f
    worth = n * var_y / spread
    value = float(np.clip(weight * np.mean([*f, *rest]) + np.mean(y - weight * f), 0, 1))
    rate = score_interval(value, worth, level)
    return CorrectedRate(rate, weight, value * (1 - value) / worth, n, worth)
