"""Curves over frames, of a metric that is registered here alone."""

from dataclasses import replace

import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.evaluation import registry
from rsjax.evaluation.evaluate import frame_curves
from rsjax.evaluation.registry import Scene, Unavailable, metric
from rsjax.evaluation.statistics import bootstrap

VALUES = np.random.default_rng(0).normal(20, 3, (30, 4))
VALUES[:7, 1] = np.nan
VALUES[:, 2] = np.nan


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The registry is empty during each test."""
    monkeypatch.setattr("rsjax.evaluation.evaluate.metrics", lambda: registry._METRICS)
    monkeypatch.setattr(registry, "_METRICS", {})


def scenes(*suffixes: str) -> dict[str, Scene]:
    video = Video(np.zeros((30, 6, 16, 16, 3), np.uint8))
    return {suffix: Scene(video, video, prompt_frames=2) for suffix in suffixes}


def test_a_registered_metric_has_a_curve_and_a_band_over_the_clips_with_a_score() -> None:
    metric("noise", "noise", better="lower", per_frame=lambda scene: VALUES)(lambda scene: VALUES[:, 0])
    metric("plain", "plain", better="lower")(lambda scene: VALUES[:, 0])
    curves = frame_curves(scenes("", "_repeat_first"))
    band = {f"noise{suffix}{edge}" for suffix in ("", "_repeat_first") for edge in ("", "_low", "_high")}
    assert curves.keys() == {"frame"} | band
    assert curves["frame"] == [3, 4, 5, 6]
    for t, known in ((0, VALUES[:, 0]), (1, VALUES[7:, 1]), (3, VALUES[:, 3])):
        expected = bootstrap(known, seed=1)
        for edge, value in (("", known.mean()), ("_low", expected.low), ("_high", expected.high)):
            assert curves[f"noise{edge}"][t] == pytest.approx(value, abs=0.1 if edge else 1e-9)
    assert [curves[f"noise{edge}"][2] for edge in ("", "_low", "_high")] == [None] * 3


def test_a_median_stays_one_and_a_single_clip_has_no_band() -> None:
    metric("noise", "n", better="lower", statistic="median", per_frame=lambda scene: VALUES)(lambda scene: VALUES[:, 0])
    assert frame_curves(scenes(""))["noise"][0] == pytest.approx(np.median(VALUES[:, 0]))
    metric("one", "n", better="lower", per_frame=lambda scene: VALUES[:1])(lambda scene: VALUES[:1, 0])
    curves = frame_curves(scenes(""))
    assert (curves["one"][0], curves["one_low"][0]) == (VALUES[0, 0], None)


def test_what_cannot_be_scored_and_baselines_without_other_actions_have_no_curve() -> None:
    def per_frame(scene: Scene) -> np.ndarray:
        raise Unavailable("no weights")

    metric("absent", "absent", better="lower", per_frame=per_frame)(lambda scene: VALUES[:, 0])
    delta = metric("delta", "delta", better="higher", needs=("other",), per_frame=lambda scene: VALUES)
    delta(lambda scene: VALUES[:, 0])
    both = scenes("", "_tokenizer")
    both[""] = replace(both[""], alternatives={"other": [both[""].truth]})
    assert frame_curves(both).keys() == {"frame", "delta", "delta_low", "delta_high"}
