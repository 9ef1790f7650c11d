import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.evaluation.metrics.depth import abs_rel, align, depth_scores, result_key, within


def _videos(seed=0, shape=(2, 3, 4, 5)):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.4, 3.0, shape)
    return truth.astype(np.float32), (truth * rng.uniform(0.6, 1.6, shape)).astype(np.float32)


def test_unaligned_scores_are_their_definitions_pixel_by_pixel():
    truth, prediction = _videos()
    got = depth_scores(truth, prediction, "none")
    for b in range(len(truth)):
        errors, hits1, hits2 = [], [], []
        for d, p in zip(truth[b].ravel(), prediction[b].ravel(), strict=True):
            errors.append(abs(p - d) / d)
            hits1.append(max(p / d, d / p) < 1.25)
            hits2.append(max(p / d, d / p) < 1.25**2)
        np.testing.assert_allclose(got.abs_rel[b], np.mean(errors), rtol=1e-6)
        np.testing.assert_allclose([got.delta1[b], got.delta2[b]], [np.mean(hits1), np.mean(hits2)])
    assert 0 < got.delta1.mean() < got.delta2.mean() < 1


def test_delta_is_strict():
    truth = np.array([1.0, 1.0, 1.25, 4.0])
    prediction = np.array([1.25, np.nextafter(1.25, 0), 1.0, 4.0])
    np.testing.assert_array_equal(within(truth, prediction, 1), [False, True, False, True])
    np.testing.assert_array_equal(within(truth, prediction, 2), [True] * 4)


@pytest.mark.parametrize("alignment", ["median", "l1_scale"])
@settings(max_examples=20, deadline=None)
@given(scale=st.floats(0.05, 20))
def test_a_scale_is_fitted_away(alignment, scale):
    truth, _ = _videos()
    scores = depth_scores(truth, truth * scale, alignment)
    np.testing.assert_allclose(scores.abs_rel, 0, atol=1e-5)
    assert (scores.delta1 == 1).all()


@settings(max_examples=20, deadline=None)
@given(scale=st.floats(0.1, 10), shift=st.floats(0, 2))
def test_a_scale_and_shift_of_disparity_is_fitted_away(scale, shift):
    truth, _ = _videos()
    estimate = 1 / (scale / truth + shift)
    np.testing.assert_allclose(depth_scores(truth, estimate, "affine_disparity").abs_rel, 0, atol=1e-4)
    assert shift < 0.1 or (depth_scores(truth, estimate, "median").abs_rel > 1e-3).all()


def test_each_video_gets_one_fit_of_its_own():
    truth, prediction = _videos()
    rescaled = prediction * np.array([3.0, 0.2], np.float32)[:, None, None, None]
    for alignment in ("median", "l1_scale"):
        np.testing.assert_allclose(
            depth_scores(truth, prediction, alignment).abs_rel,
            depth_scores(truth, rescaled, alignment).abs_rel,
            rtol=1e-5,
        )
    frame_scaled = truth * np.array([1.0, 2.0, 4.0], np.float32)[:, None, None]
    assert (depth_scores(truth, frame_scaled, "median").abs_rel > 0.3).all()


def test_median_against_the_formula_and_l1_against_a_search():
    truth, prediction = _videos(3)
    d, p = truth[0], prediction[0]
    mask = np.ones(d.shape, bool)
    np.testing.assert_allclose(align(d, p, mask, "median"), p * np.median(d) / np.median(p), rtol=1e-6)
    scale = (align(d, p, mask, "l1_scale") / p).mean()
    grid = np.linspace(0.3, 3, 4001)
    costs = np.abs(grid[:, None] * p.ravel() - d.ravel()).sum(1)
    assert np.abs(scale * p - d).sum() <= costs.min() * 1.01


def test_pixels_without_depth_never_count():
    truth, prediction = _videos()
    holed, junk = truth.copy(), prediction.copy()
    holes = np.random.default_rng(1).random(truth.shape) < 0.3
    holed[holes] = np.where(np.random.default_rng(2).random(holes.sum()) < 0.5, 0, np.nan)
    junk[holes] = 900.0
    for alignment in ("none", "median", "affine_disparity", "l1_scale"):
        got = depth_scores(holed, junk, alignment)
        other = depth_scores(holed, np.where(holes, 1.0, prediction), alignment)
        np.testing.assert_allclose(got.abs_rel, other.abs_rel)
        assert np.isfinite(got.abs_rel).all()


def test_averaging_differs_as_the_protocols_say():
    """Video 0: frame 0 has one valid pixel with error 1, frame 1 four pixels with error 0; video 1 likewise, full."""
    truth, prediction = np.ones((2, 2, 2, 2)), np.ones((2, 2, 2, 2))
    truth[0, 0].flat[1:] = 0
    prediction[:, 0] = 2.0
    per_pixel = depth_scores(truth, prediction, "none")
    np.testing.assert_allclose(per_pixel.abs_rel, [1 / 5, 1 / 2])
    np.testing.assert_allclose(per_pixel.mean()["absrel"], (1 / 5 + 1 / 2) / 2)
    pooled = depth_scores(truth, prediction, "l1_scale")
    np.testing.assert_allclose(pooled.weight, [5, 8])
    np.testing.assert_allclose(pooled.mean()["absrel"], (5 * pooled.abs_rel[0] + 8 * pooled.abs_rel[1]) / 13)
    by_frame = depth_scores(truth, prediction, "affine_disparity")
    aligned = align(truth[0], prediction[0], truth[0] > 0, "affine_disparity")
    frames = [abs_rel(d[d > 0], a[d > 0]).mean() for d, a in zip(truth[0], aligned, strict=True)]
    np.testing.assert_allclose(by_frame.abs_rel[0], np.mean(frames))


def test_bad_input_is_named():
    truth, prediction = _videos()
    with pytest.raises(ValueError, match="video 1 has no pixel"):
        depth_scores(truth * np.array([1, 0])[:, None, None, None], prediction, "median")
    with pytest.raises(ValueError, match="not finite"):
        depth_scores(truth, prediction * np.nan)
    with pytest.raises(ValueError, match="both must be the same"):
        depth_scores(truth, prediction[:, 1:])
    with pytest.raises(ValueError, match="unknown depth alignment 'mean'"):
        depth_scores(truth, prediction, "mean")


def test_keys_tell_the_protocols_apart():
    keys = {
        result_key("absrel", alignment, source)
        for alignment in ("none", "median", "affine_disparity", "l1_scale")
        for source in ("branch", "estimator")
    }
    assert len(keys) == 8
    assert "depth_absrel" in keys
    assert "depth_absrel_median_estimator" in keys
