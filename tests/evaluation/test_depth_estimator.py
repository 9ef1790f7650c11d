import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from rsjax.config import ConfigError, EvalConfig
from rsjax.evaluation import evaluate as evaluation
from rsjax.evaluation.depth_estimator import by_content, choose_estimator, estimate_depth
from rsjax.tools.ingest.annotators.depth import metric_depth, relative_depth
from rsjax.tools.ingest.annotators.protocols import AnnotationError, DepthMaps
from rsjax.tools.ingest.episode import Episode
from tests.tools.ingest.annotators.networks.checkouts import check_out
from tests.tools.pipeline import toy


@dataclass(frozen=True)
class Brightness:
    """Takes a pixel's mean level, and a bit, for its 1/depth or its decimetres."""

    metric: bool

    def __call__(self, episode: Episode, camera: str) -> DepthMaps:
        frames = episode.cameras[camera]
        level = frames.read(range(len(frames))).mean(-1).astype(np.float32) + 20
        return metric_depth(level / 10) if self.metric else relative_depth(level)


def videos(seed: int, low: int, high: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(low, high, (3, 4, 5, 6, 3), np.uint8)


def test_depth_in_metres_is_the_networks_own() -> None:
    truth, made = videos(0, 0, 256), videos(1, 0, 256)
    estimated = estimate_depth(Brightness(metric=True), truth, {"": made, "_tokenizer": truth})
    np.testing.assert_allclose(estimated[""].truth, 2 + truth.mean(-1) / 10, rtol=1e-6)
    np.testing.assert_allclose(estimated[""].prediction, 2 + made.mean(-1) / 10, rtol=1e-6)
    np.testing.assert_array_equal(estimated["_tokenizer"].prediction, estimated["_tokenizer"].truth)


def test_relative_depth_of_both_videos_is_stretched_as_the_recorded_one() -> None:
    truth, made = videos(0, 60, 200), videos(1, 0, 256)
    estimated = estimate_depth(Brightness(metric=False), truth, {"": made})[""]
    for clip in range(3):
        inverse = truth[clip].mean(-1)
        low, high = inverse.min(), inverse.max()
        for found, frames in ((estimated.truth, truth), (estimated.prediction, made)):
            inside = 0.1 + 0.9 * (frames[clip].mean(-1) - low) / (high - low)
            np.testing.assert_allclose(1 / found[clip], np.maximum(inside, 1e-3), rtol=1e-3, atol=1e-4)
    assert estimated.truth.min() == pytest.approx(1) and estimated.truth.max() == pytest.approx(10, rel=1e-4)
    assert estimated.prediction.min() < 1 and estimated.prediction.max() > 10


@pytest.mark.parametrize("metric", [True, False])
def test_a_model_without_depth_on_clips_without_depth_has_the_estimators_scores(
    metric: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "choose_estimator", lambda settings, load=False: Brightness(metric))
    blind = toy.store(tmp_path / "clips", depth=False)
    found = evaluation.evaluate(toy.trained(blind, toy.with_model(toy.config(), use_depth=False)), blind)
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


def test_the_configured_network_is_loaded_from_its_files(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    checkout = check_out(tmp_path, "video_depth_anything/video_depth.py")
    torch.save({"scale": torch.full((64,), 2.0)}, tmp_path / "w")
    word = f"video-depth-anything:checkout={checkout},weights={tmp_path / 'w'},device=cpu"
    estimator = choose_estimator(EvalConfig(depth_estimator=word))
    assert estimator is not None
    truth, made = videos(0, 60, 200), videos(1, 60, 200)
    both = [estimate_depth(network, truth, {"": made})[""] for network in (estimator, Brightness(metric=False))]
    np.testing.assert_allclose(both[0].prediction, both[1].prediction, rtol=1e-3)
    (tmp_path / "w").write_bytes(b"not weights")
    with pytest.raises(AnnotationError, match="not the weights of Video Depth Anything"):
        choose_estimator(EvalConfig(depth_estimator=f"{word},input_size=14"), load=True)
    for name in [name for name in sys.modules if name.startswith("video_depth_anything")]:
        del sys.modules[name]  # other tests have checkouts of their own


def test_an_estimator_is_known_by_the_content_of_its_files(tmp_path: Path) -> None:
    def described(folder: Path, more: str = "") -> str:
        word = f"video-depth-anything:checkout={folder},weights={folder / 'w'}{more}"
        return by_content(EvalConfig(depth_estimator=word))

    for name in ("here", "there"):
        check_out(tmp_path / name, "video_depth_anything/video_depth.py")
        (tmp_path / name / "w").write_bytes(b"1")
    here, there = tmp_path / "here", tmp_path / "there"
    first = described(here)
    (there / "README.md").write_text("no code")
    assert described(there) == first != described(there, ",input_size=14")
    assert str(tmp_path) not in first
    (there / "w").write_bytes(b"2")
    (here / "video_depth_anything" / "more.py").touch()
    assert len({first, described(there), described(here)}) == 3
    assert by_content(EvalConfig()) == ""


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("midas", "eval.depth_estimator: depth: no method 'midas'; choose"),
        ("recorded", "eval.depth_estimator: 'recorded' is no network"),
        ("none", "eval.depth_estimator: 'none' is no network"),
        ("depth-anything", "eval.depth_estimator: depth depth-anything: model missing; write"),
        ("depth-anything:model=nowhere", r"eval.depth_estimator: model .*/nowhere does not exist"),
    ],
)
def test_an_estimator_that_cannot_be_is_refused_at_the_start(word: str, message: str) -> None:
    assert choose_estimator(EvalConfig()) is None
    with pytest.raises(ConfigError, match=message):
        evaluation.check_files(replace(EvalConfig(), depth_estimator=word))
