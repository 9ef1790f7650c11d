import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.tools.policies.studies.agreement import agreement, correlation, fisher, inner, over_trainings, ranks

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


TRUE = np.array([0, 0, 0, 26, 30, 50, 60, 74]) / 100
MADE = np.array([[0, 0, 6, 56, 88, 92, 94, 98], [0, 0, 2, 60, 86, 96, 96, 96]]) / 100  # docs/results/policies.md


def test_policies_that_always_fail_carry_the_correlation() -> None:
    found = agreement(TRUE, MADE[0])
    assert found.inner == 5 and found.pearson_inner.value == pytest.approx(0.763, abs=1e-3)
    assert found.pearson.value > 0.92
    assert found.bias_middle == pytest.approx(0.376) and found.bias == pytest.approx(0.2425)
    assert inner(np.array([0, 0.02, 1])).tolist() == [False, True, False]
    ends = agreement(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    assert ends.inner == 0 and np.isnan(ends.pearson_inner.value) and np.isnan(ends.bias_middle)


def test_an_interval_takes_two_trainings_of_policies() -> None:
    one = over_trainings(TRUE, MADE, ["a"] * 8)
    assert one.value == pytest.approx(np.mean([correlation(TRUE, made) for made in MADE]))
    assert one.low is None and one.high is None
    two = over_trainings(TRUE, MADE, [*"aaaabbbb"])
    assert two.low is not None and two.high is not None and two.low < two.value == one.value < two.high
    perfect = over_trainings(TRUE, TRUE[None], [*"aaaabbbb"])
    assert perfect.value == pytest.approx(1) and perfect.low is None
    assert np.isnan(over_trainings(TRUE, 0 * MADE, [*"aaaabbbb"]).value)


def test_it_is_a_loop_over_resampled_trainings() -> None:
    names = np.array([*"abababab"])
    rng = np.random.default_rng(5)
    drawn = []
    for _ in range(4000):
        policies = np.concatenate([np.flatnonzero(names == name) for name in rng.choice([*"ab"], 2)])
        drawn.append(np.mean([correlation(TRUE[policies], made[policies]) for made in MADE[rng.integers(2, size=2)]]))
    error = np.nanstd(np.arctanh(drawn)) * np.sqrt(2)
    found = over_trainings(TRUE, MADE, names.tolist(), resamples=4000)
    assert found.low is not None
    assert (np.arctanh(found.value) - np.arctanh(found.low)) / 12.706 == pytest.approx(error, rel=0.1)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_the_interval_covers_what_many_trainings_give(count: int) -> None:
    """Trainings differ in how fast their policies learn, and in how kind the model is to them."""
    rng = np.random.default_rng(count)

    def rates(trainings: int) -> tuple[np.ndarray, np.ndarray]:
        skill = np.linspace(-4, 2, 8) + rng.normal(0, 0.5, (trainings, 1))
        seen = skill + 1.5 + rng.normal(0, 0.5, (trainings, 1)) + rng.normal(0, 0.3, (trainings, 8))
        return tuple(rng.binomial(50, 1 / (1 + np.exp(-each))).ravel() / 50 for each in (skill, seen))  # type: ignore[return-value]

    truth = correlation(*rates(20_000))
    names = np.repeat(np.arange(count), 8).astype(str).tolist()
    covered = []
    for seed in range(400):
        true, made = rates(count)
        found = over_trainings(true, made[None], names, seed, resamples=200)
        covered.append(found.low is not None and found.low <= truth <= found.high)  # type: ignore[operator]
    assert 0.9 <= np.mean(covered) <= 0.99
