from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsjax.config import EvalConfig, NoDepth
from rsjax.evaluation.depth_estimator import DepthMaps, estimate_depth
from rsjax.evaluation.evaluate import evaluate
from tests.tools.pipeline import toy


def brightness_in_decimetres(frames: np.ndarray) -> DepthMaps:
    level = frames.mean(-1).astype(np.float32) + 20
    return DepthMaps(level / 10, "metres", (2.0, 27.5))


def brightness_as_inverse(frames: np.ndarray) -> DepthMaps:
    level = frames.mean(-1).astype(np.float32) + 20
    return DepthMaps(level, "relative 1/depth", (float(level.min()), float(level.max())))


def videos(seed: int, low: int, high: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(low, high, (3, 4, 5, 6, 3), np.uint8)


def test_depth_in_metres_is_the_networks_own() -> None:
    truth, made = videos(0, 0, 256), videos(1, 0, 256)
    estimated = estimate_depth(brightness_in_decimetres, truth, {"": made, "_tokenizer": truth})
    np.testing.assert_allclose(estimated[""].truth, 2 + truth.mean(-1) / 10, rtol=1e-6)
    np.testing.assert_allclose(estimated[""].prediction, 2 + made.mean(-1) / 10, rtol=1e-6)
    np.testing.assert_array_equal(estimated["_tokenizer"].prediction, estimated["_tokenizer"].truth)


def test_relative_depth_of_both_videos_is_stretched_as_the_recorded_one() -> None:
    truth, made = videos(0, 60, 200), videos(1, 0, 256)
    estimated = estimate_depth(brightness_as_inverse, truth, {"": made})[""]
    for clip in range(3):
        inverse = truth[clip].mean(-1)
        low, high = inverse.min(), inverse.max()
        for found, frames in ((estimated.truth, truth), (estimated.prediction, made)):
            inside = 0.1 + 0.9 * (frames[clip].mean(-1) - low) / (high - low)
            np.testing.assert_allclose(1 / found[clip], np.maximum(inside, 1e-3), rtol=1e-3, atol=1e-4)
    assert estimated.truth.min() == pytest.approx(1) and estimated.truth.max() == pytest.approx(10, rel=1e-4)
    assert estimated.prediction.min() < 1 and estimated.prediction.max() > 10


def test_a_model_without_depth_on_clips_without_depth_has_the_estimators_scores(tmp_path: Path) -> None:
    blind = toy.store(tmp_path / "clips", depth=False)
    settings = EvalConfig(clips=2, batch_size=2, action_draws=1, weights="")
    trained = toy.trained(blind, replace(toy.with_model(toy.config(), depth=NoDepth()), eval=settings))
    found = evaluate(trained, blind, estimator=brightness_as_inverse)
    depth = {name: value for name, value in found.metrics.items() if "depth" in name}
    assert {name.rpartition("_estimator")[0] for name in depth} == {
        f"depth_{measure}_{alignment}"
        for measure in ("absrel", "delta1", "delta2")
        for alignment in ("median", "affine_disparity", "l1_scale")
    }
    assert {"depth_absrel_median_estimator_repeat_first", "depth_delta1_l1_scale_estimator_tokenizer"} <= depth.keys()
    assert np.isfinite([*depth.values()]).all()
    assert {found.reasons[name] for name in found.reasons if "branch" in name} == {"no test clip has depth in metres"}
    assert "depth_absrel_median_estimator" not in found.reasons
