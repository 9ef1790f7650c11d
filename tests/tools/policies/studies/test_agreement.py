import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.tools.policies.studies.agreement import agreement, fisher, ranks

RATES = st.lists(st.tuples(st.integers(0, 50), st.integers(0, 50)), min_size=2, max_size=10)


@given(RATES)
def test_it_equals_scipy(pairs: list[tuple[int, int]]) -> None:
    stats = pytest.importorskip("scipy.stats")
    x, y = np.array(pairs, float).T / 50
    found = agreement(x, y)
    np.testing.assert_allclose(ranks(x), stats.rankdata(x))
    if len(set(x)) > 1 and len(set(y)) > 1:
        assert found.pearson.value == pytest.approx(stats.pearsonr(x, y)[0], abs=1e-9)
        assert found.spearman == pytest.approx(stats.spearmanr(x, y)[0], abs=1e-9)
        assert found.r2_line == pytest.approx(stats.linregress(x, y).rvalue ** 2, abs=1e-9)
        if len(x) >= 4 and abs(found.pearson.value) < 0.999:
            low, high = stats.pearsonr(x, y).confidence_interval()
            assert (found.pearson.low, found.pearson.high) == pytest.approx((low, high), abs=1e-6)
    else:
        assert np.isnan(found.pearson.value)


def test_the_papers_interval() -> None:
    interval = fisher(0.953, 8)
    assert interval.low is not None and interval.high is not None
    assert (round(interval.low, 2), round(interval.high, 2)) == (0.76, 0.99)


@given(RATES)
def test_a_perfect_predictor_and_a_shifted_one(pairs: list[tuple[int, int]]) -> None:
    x = np.array(pairs, float)[:, 0] / 50
    perfect, shifted = agreement(x, x), agreement(x, 0.5 * x + 0.1)
    assert (perfect.mmrv, perfect.bias) == (0, 0)
    assert shifted.mmrv == 0 and shifted.bias == pytest.approx(np.mean(0.1 - 0.5 * x))
    if len(set(x)) > 1:
        assert perfect.r2_identity == pytest.approx(1)
        assert perfect.r2_prediction == pytest.approx(1)
        assert shifted.r2_line == pytest.approx(1) and shifted.r2_identity < 1
        for found in (perfect, shifted):  # rounding is no interval of width 0, and no correlation above 1
            assert found.pearson.low is None and found.pearson.high is None
            assert max(found.pearson.value, found.spearman, found.r2_line) <= 1


def test_the_line_y_x_and_the_prediction_of_x_have_different_spreads() -> None:
    """The rates of docs/results/policies.md: of the spread of y the line is better than the mean, of x far worse."""
    x, y = np.array([[0, 0, 0, 2, 12, 20, 26, 30], [0, 0, 4, 4, 16, 74, 82, 78]]) / 100
    found = agreement(x, y)
    assert (found.r2_identity, found.r2_prediction) == (pytest.approx(0.18, abs=0.005), pytest.approx(-6.55, abs=0.005))
    assert found.r2_identity <= found.r2_line
    swapped = agreement(y, x)
    assert (swapped.r2_prediction, swapped.r2_identity) == pytest.approx((found.r2_identity, found.r2_prediction))


def test_a_wrong_rank_costs_what_lies_between() -> None:
    assert agreement(np.array([0.1, 0.5, 0.9]), np.array([0.2, 0.9, 0.8])).mmrv == pytest.approx((0 + 0.4 + 0.4) / 3)
    with pytest.raises(ValueError, match="the same two policies or more"):
        agreement(np.array([0.1]), np.array([0.2]))
