import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from rsjax.evaluation.statistics import (
    Estimate,
    bootstrap,
    holm,
    nested_bootstrap,
    over_predicted_frames,
    paired_bootstrap,
    paired_t,
    share_difference,
    verdict,
    welch,
    wilson,
)


def test_mean_over_predicted_frames_only():
    values = np.array([[100.0, 1, 2, 3], [100.0, 4, 5, 6]])
    np.testing.assert_allclose(over_predicted_frames(values), [2, 5])
    np.testing.assert_allclose(over_predicted_frames(values, 3), [3, 6])
    with pytest.raises(ValueError, match="none is left"):
        over_predicted_frames(values, 4)


def test_bootstrap_agrees_with_a_loop_and_with_normal_theory():
    values = np.random.default_rng(0).normal(20, 3, 40)
    got = bootstrap(values)
    rng = np.random.default_rng(99)
    means = [rng.choice(values, len(values)).mean() for _ in range(10_000)]
    assert got.value == pytest.approx(values.mean())
    assert bootstrap(values, seed=3) == bootstrap(values, seed=3) != bootstrap(values, seed=4)
    np.testing.assert_allclose([got.low, got.high], np.quantile(means, [0.025, 0.975]), atol=0.05)
    np.testing.assert_allclose(got.high - got.low, 2 * 1.96 * values.std() / np.sqrt(40), rtol=0.05)
    assert got.flat("psnr") == {"psnr": got.value, "psnr_low": got.low, "psnr_high": got.high}
    assert bootstrap(np.array([7.0])).flat("psnr") == {"psnr": 7.0}, "one clip has no interval"


@pytest.mark.parametrize("values", [[], [1.0, np.nan], [[1.0, 2.0]]])
def test_bad_values_are_refused(values):
    with pytest.raises(ValueError, match="one finite number per clip"):
        bootstrap(np.array(values))


def test_paired_bootstrap_of_one_seed_is_the_bootstrap_of_differences():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(2, 1, 25))
    got, expected = paired_bootstrap(a, b), bootstrap((a - b)[0])
    np.testing.assert_allclose([got.value, got.low, got.high], [expected.value, expected.low, expected.high])


def test_paired_bootstrap_of_medians_is_of_the_difference_of_the_scores_shown():
    """Medians of differences would be 0 here, as two of three clips score alike in both."""
    a, b = np.tile([[0.0, 1.0, 2.0], [0.0, 3.0, 4.0]], 20), np.tile([[0.0, 1.0, 0.0]], 20)
    got = paired_bootstrap(a, b, statistic="median")
    assert got.value == np.median(a, axis=1).mean() - np.median(b) == 2.0
    alone = paired_bootstrap(a[:1], 0 * b, statistic="median")
    expected = bootstrap(a[0], statistic="median")
    assert (alone.value, alone.low, alone.high) == (expected.value, expected.low, expected.high)


def test_paired_bootstrap_removes_what_clips_share_and_keeps_what_seeds_vary():
    rng = np.random.default_rng(3)
    clips = rng.normal(0, 10, 60)
    seeds_a, seeds_b = rng.normal(0, 1, (5, 1)), rng.normal(0, 1, (4, 1))
    got = paired_bootstrap(clips + seeds_a, clips + seeds_b)  # differences of clips are equal: only seeds vary
    error = np.sqrt(seeds_a.var() / 5 + seeds_b.var() / 4)
    assert got.value == pytest.approx(seeds_a.mean() - seeds_b.mean())
    np.testing.assert_allclose((got.high - got.low) / 2, 1.96 * error, rtol=0.1)
    swapped = paired_bootstrap(clips + seeds_b, clips + seeds_a)
    np.testing.assert_allclose([swapped.low, swapped.high], [-got.high, -got.low], atol=0.15)


def test_welch_agrees_with_scipy():
    a, b = np.array([21.3, 21.9, 20.8, 21.1]), np.array([20.1, 20.9, 20.6])
    got, expected = welch(a, b), stats.ttest_ind(a, b, equal_var=False)
    interval = expected.confidence_interval()
    np.testing.assert_allclose([got.t, got.p, got.df], [expected.statistic, expected.pvalue, expected.df])
    np.testing.assert_allclose([got.difference.low, got.difference.high], [interval.low, interval.high])


def test_welch_without_variance_or_seeds():
    assert welch([1.0], [2.0, 3.0]) is None
    assert welch([1.0, 1.0], [1.0, 1.0]).p == 1
    assert welch([1.0, 1.0], [2.0, 2.0]).t == -np.inf


@pytest.mark.parametrize(("successes", "trials"), [(0, 8), (3, 10), (17, 20), (50, 50)])
def test_wilson_agrees_with_scipy(successes, trials):
    expected = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    got = wilson(successes, trials)
    np.testing.assert_allclose([got.low, got.high], [expected.low, expected.high], atol=1e-12)
    with pytest.raises(ValueError, match="have no share"):
        wilson(trials + 1, trials)


@pytest.mark.parametrize(
    ("low", "high", "direction", "margin", "expected"),
    [
        (0.1, 0.5, "higher", 0, "holds"),
        (0.1, 0.5, "lower", 0, "does not hold"),
        (-0.1, 0.5, "higher", 0, "cannot tell"),
        (-0.5, -0.1, "lower", 0, "holds"),
        (0.1, 0.5, "higher", 0.2, "cannot tell"),
        (0.1, 0.15, "higher", 0.2, "does not hold"),
        (-0.1, 0.1, "higher", -0.2, "holds"),
        (-0.1, 0.1, "lower", -0.2, "holds"),
        (None, None, "higher", 0, "cannot tell"),
    ],
)
def test_a_verdict_is_what_the_interval_says(low, high, direction, margin, expected):
    assert verdict(Estimate(0.0, low, high), direction, margin) == expected
    assert verdict(None) == "cannot tell"


@pytest.mark.parametrize("other", [np.zeros((2, 4)), np.full((1, 3), np.nan), np.zeros((0, 3))])
def test_clips_that_cannot_be_paired_are_refused(other):
    with pytest.raises(ValueError, match="finite number per seed and clip"):
        paired_bootstrap(np.zeros((2, 3)), other)


def test_the_difference_of_shares_is_newcombes_and_tells_nothing_of_few_trials_that_end_alike() -> None:
    """Newcombe (1998), method 10: 56/70 and 48/80 differ by 0.2, from 0.0524 to 0.3339."""
    gap = share_difference(np.arange(70) < 56, np.arange(80) < 48)
    assert (gap.value, gap.low, gap.high) == pytest.approx((0.2, 0.0524, 0.3339), abs=1e-4)
    alike = share_difference(np.zeros(2), np.zeros(2))
    assert verdict(alike, "higher", -0.1) == "cannot tell"
    assert verdict(share_difference(np.zeros(60), np.zeros(60)), "higher", -0.1) == "holds"
    with pytest.raises(ValueError, match="no share"):
        share_difference([], [1])


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_holms_p_rejects_what_holms_steps_reject(p: list[float]) -> None:
    """Holm (1979): reject the smallest p while it is at most level / (hypotheses that are left)."""
    adjusted = holm(p)
    for level in (0.001, 0.01, 0.05, 0.2, 0.9):
        left = sorted(range(len(p)), key=lambda i: p[i])
        rejected = set()
        while left and p[left[0]] <= level / len(left):
            rejected.add(left.pop(0))
        near = np.isclose(adjusted, level)  # p × n and level / n may round differently
        assert {i for i in range(len(p)) if adjusted[i] <= level and not near[i]} == {
            i for i in rejected if not near[i]
        }
    assert (adjusted >= p).all() and (adjusted <= 1).all()


def test_a_paired_t_test_agrees_with_scipy():
    a, b = np.array([21.3, 21.9, 20.8, 21.1]), np.array([20.1, 21.2, 20.6, 20.4])
    got, expected = paired_t(a, b), stats.ttest_rel(a, b)
    interval = expected.confidence_interval()
    np.testing.assert_allclose([got.t, got.p, got.df], [expected.statistic, expected.pvalue, expected.df])
    np.testing.assert_allclose([got.difference.low, got.difference.high], [interval.low, interval.high])
    assert paired_t(a[:1], b[:1]) is None


def test_two_one_sided_tests_agree_with_scipy():
    rng = np.random.default_rng(4)
    a, b = rng.normal(0.05, 0.1, 5), rng.normal(0, 0.1, 6)
    above = stats.ttest_ind(a, b - 0.2, equal_var=False, alternative="greater").pvalue  # of a - b > -0.2
    below = stats.ttest_ind(a, b + 0.2, equal_var=False, alternative="less").pvalue
    assert welch(a, b).p_beyond(0.2) == pytest.approx(max(above, below))
    assert welch(a, b).p_of(0.1) == pytest.approx(stats.ttest_ind(a, b + 0.1, equal_var=False).pvalue)
    same = welch([1.0, 1.0], [1.0, 1.0])
    assert (same.p_beyond(0.1), same.p_beyond(0.0), same.p_of(0.0), same.p_of(0.1)) == (0, 1, 1, 0)


def test_a_nested_bootstrap_pairs_seeds_that_have_their_own_clips():
    """Seeds differ by 5 and clips by 3, alike in both: neither widens the interval of their difference."""
    rng = np.random.default_rng(5)
    b = [rng.normal(rng.normal(0, 5), 3, clips) for clips in (30, 40, 25, 35)]
    gains = np.array([0.4, 0.5, 0.6, 0.5])
    got = nested_bootstrap([row + gain for row, gain in zip(b, gains, strict=True)], b)
    assert got.value == pytest.approx(0.5)
    assert 0.4 <= got.low < 0.5 < got.high <= 0.6
    noisy = [row + 0.5 + rng.normal(0, 1, len(row)) for row in b]
    drawn = []
    for _ in range(2000):
        rows = [rng.integers(len(row), size=len(row)) for row in b]
        means = np.array([(one - other)[row].mean() for one, other, row in zip(noisy, b, rows, strict=True)])
        drawn.append(rng.choice(means, 4).mean())
    got = nested_bootstrap(noisy, b)
    np.testing.assert_allclose([got.low, got.high], np.quantile(drawn, [0.025, 0.975]), atol=0.04)
    with pytest.raises(ValueError):  # noqa: PT011
        nested_bootstrap(b, b[:3])
