import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.clip import Video
from rsjax.evaluation.metrics import depth
from rsjax.evaluation.metrics.depth import abs_rel, align, depth_scores, result_key, within
from rsjax.evaluation.registry import EstimatedDepth, Scene, Unavailable, metrics


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
    np.testing.assert_allclose(per_pixel.per_clip("absrel").mean(), (1 / 5 + 1 / 2) / 2)
    pooled = depth_scores(truth, prediction, "l1_scale")
    np.testing.assert_allclose(pooled.weight, [5, 8])
    np.testing.assert_allclose(pooled.per_clip("absrel").mean(), (5 * pooled.abs_rel[0] + 8 * pooled.abs_rel[1]) / 13)
    by_frame = depth_scores(truth, prediction, "affine_disparity")
    aligned = align(truth[0], prediction[0], truth[0] > 0, "affine_disparity")
    frames = [abs_rel(d[d > 0], a[d > 0]).mean() for d, a in zip(truth[0], aligned, strict=True)]
    np.testing.assert_allclose(by_frame.abs_rel[0], np.mean(frames))


def test_bad_input_is_named():
    truth, prediction = _videos()
    for inputs, message in (
        ((truth, prediction[:, 1:], "none"), "both must be the same"),
        ((truth, prediction, "mean"), "unknown depth alignment 'mean'"),
    ):
        with pytest.raises(ValueError, match=message):
            depth_scores(*inputs)


def _scene(**changes):
    """Four clips of four frames, the first of which is the prompt, as recorded, generated, and by an estimator."""
    rng = np.random.default_rng(5)
    truth, prediction, estimated, other = (rng.uniform(0.5, 3.0, (4, 4, 6, 7)).astype(np.float32) for _ in range(4))
    rgb = np.zeros((4, 4, 6, 7, 3), np.uint8)
    scene = Scene(Video(rgb, truth), Video(rgb, prediction), 1, estimated=EstimatedDepth(estimated, other))
    return dataclasses.replace(scene, **changes)


def _by_hand(truth, prediction, alignment):
    """AbsRel, δ₁ and δ₂ of all videos, pixel by pixel; all pixels of random depth count."""
    scores = []
    for d, p in zip(truth[:, 1:].astype(np.float64), prediction[:, 1:].astype(np.float64), strict=True):
        if alignment == "median":
            fitted = p * np.median(d) / np.median(p)
        elif alignment == "affine_disparity":
            slope, offset = np.polyfit(1 / p.ravel(), 1 / d.ravel(), 1)
            fitted = 1 / np.maximum(slope / p + offset, 1e-3)
        else:
            scale = np.mean(d) / np.mean(p)
            for _ in range(10):
                weights = [1 / (abs(scale * b - a) + 1e-8) for a, b in zip(d.ravel(), p.ravel(), strict=True)]
                scale = np.average((d / p).ravel(), weights=np.array(weights) * p.ravel() ** 2)
            fitted = scale * p
        ratio = np.maximum(fitted / d, d / fitted)
        scores.append([np.mean(np.abs(fitted - d) / d), np.mean(ratio < 1.25), np.mean(ratio < 1.5625)])
    return dict(zip(("absrel", "delta1", "delta2"), np.mean(scores, 0), strict=True))


@pytest.mark.parametrize("source", ["branch", "estimator"])
@pytest.mark.parametrize("alignment", ["median", "affine_disparity", "l1_scale"])
def test_registered_scores_are_their_definitions_over_predicted_frames(alignment, source):
    scene = _scene()
    pair = (
        (scene.truth.depth, scene.prediction.depth)
        if source == "branch"
        else (scene.estimated.truth, scene.estimated.prediction)
    )
    for measure, expected in _by_hand(*pair, alignment).items():
        scored = metrics()[result_key(measure, alignment, source)].function(scene)
        assert np.mean(scored) == pytest.approx(expected, rel=1e-5), measure


def test_the_branch_is_scored_where_recorded_depth_is_in_metres():
    scene = _scene()
    blind = scene.truth.depth.copy()
    blind[[0, 2]] = np.nan
    part = dataclasses.replace(scene, truth=Video(scene.truth.rgb, blind))
    function = metrics()["depth_absrel_median_branch"].function
    np.testing.assert_array_equal(function(part), function(scene)[[1, 3]])
    estimated = metrics()["depth_absrel_median_estimator"].function
    np.testing.assert_array_equal(estimated(part), estimated(scene))


def test_a_frames_score_is_the_mean_over_its_own_valid_pixels():
    scene = _scene()
    truth = scene.truth.depth.copy()
    truth[1, 2] = 0  # a frame without depth
    truth[2, 3, :, :5] = 0
    scene = dataclasses.replace(scene, truth=Video(scene.truth.rgb, truth))
    got = metrics()["depth_absrel"].per_frame(scene)
    assert got.shape == (4, 3)
    for b, t in np.ndindex(4, 3):
        d, p = truth[b, t + 1], scene.prediction.depth[b, t + 1]
        expected = np.mean([abs(y - x) / x for x, y in zip(d.ravel(), p.ravel(), strict=True) if x > 0] or np.nan)
        np.testing.assert_allclose(got[b, t], expected, rtol=1e-5)
    assert np.argwhere(np.isnan(got)).tolist() == [[1, 1]]
    fitted = metrics()["depth_delta1_median_branch"]
    np.testing.assert_allclose(fitted.per_frame(_scene()).mean(-1), fitted.function(_scene()), rtol=1e-6)


def test_scores_share_one_fit(monkeypatch):
    fits = []
    monkeypatch.setattr(depth, "align", lambda *args: fits.append(args) or align(*args))
    scene = _scene()
    for measure in ("absrel", "delta1", "delta2"):
        metrics()[f"depth_{measure}_median_branch"].function(scene)
        metrics()[f"depth_{measure}_median_branch"].per_frame(scene)
    assert len(fits) == 4, "one for each video"


def _estimated(metres=True):
    truth, prediction = _videos(3, (4, 4, 6, 7))
    return EstimatedDepth(truth, prediction, metres=metres)


def _without_depth(clip):
    """The true videos, of which a clip's sensor measured nothing."""
    truth = _scene().truth
    depth = truth.depth.copy()
    depth[clip] = 0
    return dataclasses.replace(truth, depth=depth)


RGB = _scene().truth.rgb
EXACT = "depth_absrel_exact_estimator"


@pytest.mark.parametrize(
    ("name", "changes", "reason"),
    [
        ("depth_absrel", {"prediction": Video(RGB)}, "the model generates no depth"),
        ("depth_delta1_median_branch", {"truth": Video(RGB)}, "no test clip has depth in metres"),
        ("depth_delta2_l1_scale_estimator", {"estimated": None}, "no estimator: --eval.depth-estimator"),
        ("depth_absrel", {"prediction": Video(RGB, np.full((4, 4, 6, 7), np.nan))}, "are not finite"),
        ("depth_absrel_l1_scale_branch", {"truth": Video(RGB, np.full((4, 4, 6, 7), 80.0))}, "70.0 met"),
        (EXACT, {"estimated": None}, "no estimator: --eval.depth-estimator simulator"),
        (EXACT, {"estimated": _estimated(metres=False)}, "the estimator's depth is not in metres"),
        (EXACT, {"estimated": _estimated(), "truth": Video(RGB)}, "no test clip has depth in metres"),
        (EXACT, {"estimated": _estimated(), "truth": _without_depth(1)}, "true depth of video 1 has no pixel"),
    ],
)
def test_what_cannot_be_scored_has_a_reason(name, changes, reason):
    with pytest.raises(Unavailable, match=reason):
        metrics()[name].function(_scene(**changes))


def test_estimated_depth_is_scored_against_exact_depth():
    estimated = _estimated()
    scene = _scene(estimated=estimated)
    exact = scene.truth.depth[:, 1:]
    for measure in ("absrel", "delta1", "delta2"):
        scored = metrics()[f"depth_{measure}_exact_estimator"]
        scores = scored.function(scene)
        assert scores.keys() == {"", "_truth"}
        for part, depths in (("", estimated.prediction), ("_truth", estimated.truth)):
            expected = depth_scores(exact, depths[:, 1:], "none").per_clip(measure)
            np.testing.assert_array_equal(scores[part], expected)
        np.testing.assert_allclose(scored.per_frame(scene).mean(-1), scores[""], rtol=1e-6)
        baseline = scored.function(_scene(estimated=dataclasses.replace(estimated, baseline=True)))
        np.testing.assert_array_equal(baseline[""], scores[""])
        assert baseline.keys() == {""}
