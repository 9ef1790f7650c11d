"""Logistic regression: its fit is the minimum of the loss that its docstring gives."""

from dataclasses import replace

import numpy as np

from rsjax.tools.logistic_regression import LogisticRegression, fit


def test_the_fit_minimises_penalised_cross_entropy() -> None:
    rng = np.random.default_rng(0)
    features = rng.normal(size=(40, 3))
    positive = features[:, 0] + rng.normal(size=40) > 0
    rule = fit(features, positive, penalty=2.0)

    def loss(rule: LogisticRegression) -> float:
        guess = rule(features)
        entropy = -np.where(positive, np.log(guess), np.log(1 - guess)).sum()
        return float(entropy + (rule.weights**2).sum())

    for change in (*1e-3 * np.eye(4), *-1e-3 * np.eye(4)):
        assert loss(replace(rule, weights=rule.weights + change[:3], bias=rule.bias + change[3])) > loss(rule)


def test_a_feature_that_never_changes_has_no_say() -> None:
    features = np.stack([np.arange(8.0), np.full(8, 5.0)], axis=1)
    rule = fit(features, np.arange(8) > 3)
    np.testing.assert_allclose(rule(features), rule(np.add(features, [0.0, 1e-7])), atol=1e-3)
    assert ((rule(features) > 0.5) == (np.arange(8) > 3)).all()
