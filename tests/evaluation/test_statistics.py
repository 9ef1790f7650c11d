import numpy as np
import pytest

from rsjax.evaluation.statistics import bootstrap, over_predicted_frames


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
    np.testing.assert_allclose([got.low, got.high], np.quantile(means, [0.025, 0.975]), atol=0.05)
    np.testing.assert_allclose(got.high - got.low, 2 * 1.96 * values.std() / np.sqrt(40), rtol=0.05)


def test_bootstrap_is_seeded_and_covers_what_it_says():
    rng = np.random.default_rng(1)
    values = rng.normal(size=30)
    assert bootstrap(values, seed=3) == bootstrap(values, seed=3) != bootstrap(values, seed=4)
    hits = 0
    for i in range(200):
        interval = bootstrap(rng.normal(size=30), seed=i, resamples=500)
        hits += interval.low <= 0 <= interval.high
    assert 0.88 < hits / 200 < 0.99


def test_one_clip_has_a_mean_but_no_interval():
    assert bootstrap(np.array([7.0])).flat("psnr") == {"psnr": 7.0}
    assert set(bootstrap(np.array([7.0, 8.0])).flat("psnr")) == {"psnr", "psnr_low", "psnr_high"}


@pytest.mark.parametrize("values", [[], [1.0, np.nan], [[1.0, 2.0]]])
def test_bad_values_are_refused(values):
    with pytest.raises(ValueError, match="one finite number per clip"):
        bootstrap(np.array(values))
