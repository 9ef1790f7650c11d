"""Logistic regression: two kinds told apart by a weighted sum of standardised features.

Axes: N samples, M others, F features.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize
from scipy.special import expit


@dataclass(frozen=True)
class LogisticRegression:
    """A fitted rule.

    Attributes:
        mean, scale: of the features that it was fitted to.
        weights: of the standardised features.
        bias: the log odds of a sample with mean features.
    """

    mean: Float[np.ndarray, " F"]
    scale: Float[np.ndarray, " F"]
    weights: Float[np.ndarray, " F"]
    bias: float

    def __call__(self, features: Float[np.ndarray, "M F"]) -> Float[np.ndarray, " M"]:
        """Returns the probability of the positive kind, as frequent as among the samples of the fit."""
        return expit((features - self.mean) / self.scale @ self.weights + self.bias)


def fit(
    features: Float[np.ndarray, "N F"], positive: Bool[np.ndarray, " N"], penalty: float = 1.0
) -> LogisticRegression:
    """Fits the rule; the result depends on the arguments alone.

    It minimises Σ log(1 + exp(-y·(x·w + b))) + penalty/2·|w|², with y = 1 for positive samples and -1 for others.
    """
    mean = features.mean(0)
    scale = np.maximum(features.std(0), 1e-6)
    x = (features - mean) / scale
    y = np.where(positive, 1.0, -1.0)

    def loss(solution: Float[np.ndarray, " F+1"]) -> tuple[float, Float[np.ndarray, " F+1"]]:
        weights = solution[:-1]
        margin = y * (x @ weights + solution[-1])
        slope = -y * expit(-margin)
        value = np.logaddexp(0, -margin).sum() + penalty / 2 * weights @ weights
        return float(value), np.append(x.T @ slope + penalty * weights, slope.sum())

    options = {"maxiter": 1000, "gtol": 1e-6, "ftol": 1e-12}
    solution = minimize(loss, np.zeros(x.shape[1] + 1), jac=True, method="L-BFGS-B", options=options).x
    return LogisticRegression(mean, scale, solution[:-1], float(solution[-1]))
