"""Rates corrected by paired trials, against simulated worlds whose true rates are known."""

from collections.abc import Callable

import numpy as np
import pytest

from rsjax.evaluation.prediction_powered import CorrectedRate, corrected_rate
from rsjax.evaluation.statistics import wilson

REPETITIONS = 2000
Worlds = Callable[[np.random.Generator, np.ndarray], np.ndarray]


def mostly_right(rng: np.random.Generator, true: np.ndarray) -> np.ndarray:
    """A model that is wrong in one trial of ten."""
    return np.where(rng.random(true.shape) < 0.1, ~true, true)


def too_kind(rng: np.random.Generator, true: np.ndarray) -> np.ndarray:
    """A model in which half of the failures succeed."""
    return true | (rng.random(true.shape) < 0.5)


def unrelated(rng: np.random.Generator, true: np.ndarray) -> np.ndarray:
    """A model whose outcomes have nothing to do with the true ones."""
    return rng.random(true.shape) < 0.6


def repeated(
    rate: float, model: Worlds, paired: int, others: int, weight: float | None = None, seed: int = 0
) -> list[CorrectedRate]:
    """Rates from many repetitions of all trials."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(REPETITIONS):
        true = rng.random(paired + others) < rate
        made = model(rng, true)
        found.append(corrected_rate(true[:paired], made[:paired], made[paired:], weight))
    return found


@pytest.mark.parametrize(("rate", "model"), [(0.1, mostly_right), (0.35, unrelated), (0.8, too_kind)])
def test_intervals_cover_and_rates_are_unbiased_whatever_the_model(rate: float, model: Worlds) -> None:
    found = repeated(rate, model, 50, 200)
    values = np.array([one.rate.value for one in found])
    covered = np.mean([one.rate.low <= rate <= one.rate.high for one in found])  # type: ignore[operator]
    assert 0.92 <= covered <= 0.98
    assert values.mean() == pytest.approx(rate, abs=4 * values.std() / np.sqrt(REPETITIONS) + 0.003)
    assert values.var() == pytest.approx(np.mean([one.variance for one in found]), rel=0.12)


def test_few_trials_that_all_agree_do_not_make_narrow_intervals() -> None:
    """Of 10 paired trials the two that fail may fail in both worlds, though the model is often too kind."""
    covered = [one.rate.low <= 0.8 <= one.rate.high for one in repeated(0.8, too_kind, 10, 190)]  # type: ignore[operator]
    assert np.mean(covered) >= 0.92


def test_fixed_weights_are_unbiased_as_well() -> None:
    found = repeated(0.4, too_kind, 50, 150, weight=0.5)
    values = np.array([one.rate.value for one in found])
    assert values.mean() == pytest.approx(0.4, abs=4 * values.std() / np.sqrt(REPETITIONS))
    assert values.var() == pytest.approx(np.mean([one.variance for one in found]), rel=0.12)
    assert np.mean([one.rate.low <= 0.4 <= one.rate.high for one in found]) >= 0.92  # type: ignore[operator]


def outcomes(paired: int = 40, others: int = 160, seed: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    true = rng.random(paired + others) < 0.4
    made = too_kind(rng, true)
    return true[:paired], made[:paired], made[paired:]


def test_without_weight_or_other_trials_it_is_the_classical_estimate() -> None:
    true, paired, others = outcomes()
    classical = wilson(int(true.sum()), len(true))
    for found in (corrected_rate(true, paired, others, weight=0), corrected_rate(true, paired)):
        assert found.rate.value == pytest.approx(classical.value)
        assert (found.rate.low, found.rate.high) == pytest.approx((classical.low, classical.high))
        assert found.variance == pytest.approx(classical.value * (1 - classical.value) / 40)
        assert found.saved == pytest.approx(0)


def test_it_is_the_estimate_of_ppi_plus_plus() -> None:
    """Which averages the model over the other trials alone: its weight ω is λ N / M, and its best ω ours."""
    true, paired, others = outcomes()
    for weight in (0.3, 1.0):
        omega = weight * len(others) / (len(others) + len(true))
        theirs = omega * others.mean() + np.mean(true - omega * paired)
        assert corrected_rate(true, paired, others, weight).rate.value == pytest.approx(theirs)
    best = corrected_rate(true, paired, others)
    grid = [corrected_rate(true, paired, others, weight) for weight in np.linspace(0, 1, 101)]
    assert best.worth == pytest.approx(max(one.worth for one in grid), rel=1e-3)
    assert best.weight == pytest.approx(grid[int(np.argmax([one.worth for one in grid]))].weight, abs=0.01)


def test_equal_worlds_save_trials_and_unrelated_ones_do_not() -> None:
    true, _, others = outcomes(50, 350)
    same = corrected_rate(true, true, others)
    assert same.weight > 0.9 and 100 < same.saved < 350
    assert np.mean([one.saved for one in repeated(0.4, unrelated, 50, 200)]) < 5
    opposite = corrected_rate(true, ~true, others)
    assert (opposite.weight, opposite.saved) == (0, 0)  # a negative weight would be no use of a model
    assert corrected_rate(true, ~true, others, weight=1).saved < 0


@pytest.mark.parametrize("alike", [0, 1])
def test_outcomes_that_are_all_alike_show_nothing_about_the_model(alike: int) -> None:
    rest = np.arange(100) % 2
    found = corrected_rate(np.full(20, alike), np.full(20, alike), rest)
    assert found.weight == 0 and found.saved == pytest.approx(0)
    assert found.rate == wilson(20 * alike, 20)


def test_trials_that_are_not_paired_are_refused() -> None:
    for true, paired in (([], []), ([1], [1, 0]), ([[1]], [[1]])):
        with pytest.raises(ValueError) as error:  # noqa: PT011
            corrected_rate(true, paired)
        assert "same number of outcomes in both worlds" in str(error.value)
