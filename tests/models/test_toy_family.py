"""A family, a metric and a loss term that the package does not know plug into it by registration alone."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rsjax
from rsjax.config import AdamW, Config, RuntimeConfig, TrainConfig
from rsjax.errors import UserError
from rsjax.evaluation import registry
from rsjax.evaluation.registry import Scene, metric
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.run_clips import on_store
from rsjax.tools.pipeline.stages import run_all
from rsjax.tools.pipeline.videos import VideoRequest, write_videos
from rsjax.tools.studies.ablation import sweep
from rsjax.tools.studies.ablation.grid import Choice, expand, parse_axes
from tests.models.toy_family import ToyConfig
from tests.tools.pipeline import toy


@pytest.fixture
def drift() -> Iterator[None]:
    """A metric of this test alone: how far the last frame's brightness is off, and that of every predicted frame."""

    def per_frame(scene: Scene) -> np.ndarray:
        truth, predicted = (video.rgb[:, 1:].mean((2, 3, 4)) for video in (scene.truth, scene.prediction))
        return np.abs(truth - predicted)

    @metric("drift", "brightness drift", unit="levels", better="lower", decimals=1, per_frame=per_frame)
    def score(scene: Scene) -> np.ndarray:
        return per_frame(scene)[:, -1]

    yield
    del registry._METRICS["drift"]


@pytest.fixture
def config(tmp_path: Path) -> Config:
    store = toy.store(tmp_path / "clips")
    base = replace(
        toy.config(),
        model=ToyConfig(start=0.5),
        train=TrainConfig(steps=8, batch_size=3),
        runtime=RuntimeConfig(log_every=2, eval_every=4),
    )
    base = replace(base, train=replace(base.train, optimizer=AdamW(learning_rate=0.1, warmup_steps=1)))
    return on_store(base, store.path)


def test_a_toy_family_trains_generates_and_is_evaluated(config: Config, tmp_path: Path, drift: None) -> None:
    run = Run(config, tmp_path / "run", tmp_path)
    run.prepare(overwrite=False)
    run_all(run)
    assert run.stages == ("collect", "tokens", "world_model", "evaluation", "report")
    model = rsjax.load(run.directory)
    assert 0 <= model.params["gain"] < 0.5  # frames of these clips are all equally bright

    metrics = json.loads((run.directory / "metrics.json").read_text())
    assert {"psnr", "ssim", "delta_psnr", "drift", "drift_low", "drift_repeat_first"} <= metrics.keys()
    assert not {name for name, value in metrics.items() if name.endswith("_tokenizer")}
    assert {value for name, value in metrics.items() if "depth" in name} == {None}
    assert metrics["reasons"]["depth_absrel"] == "the model generates no depth"
    page = (run.directory / "report.html").read_text()
    assert page.count("brightness drift, levels ↓") == 2  # a column, and a chart
    assert ", typical: " in page and f", worst of {toy.TEST}: " in page
    assert "Where cube and gripper are" not in page
    curves = json.loads((run.directory / "curves.json").read_text())
    assert len(curves["drift"]) == len(curves["drift_low"]) == len(curves["frame"]) == config.clips.frames - 1
    assert curves["drift"][-1] == pytest.approx(metrics["drift"])
    rows = [json.loads(line) for line in (run.directory / "world_model" / "log.jsonl").read_text().splitlines()]
    assert any("validation/psnr" in row for row in rows)

    assert config.data is not None
    clip = rsjax.open_store(config.data.store).source("test")[0]
    video = model.generate(clip["rgb"][:1], clip["actions"])
    assert video.rgb.shape == clip["rgb"].shape
    many = model.plan(clip["rgb"][:1], np.stack([clip["actions"], -clip["actions"]]))
    np.testing.assert_array_equal(many.rgb[0], video.rgb)
    request = VideoRequest("test", (0,), None, None, None, {})
    (written,) = write_videos(run.directory, tmp_path, request, tmp_path / "videos", "gif", 4.0, 1)
    assert written.stat().st_size > 0


def test_a_toy_family_is_swept_over_its_own_fields(config: Config, tmp_path: Path, drift: None) -> None:
    grid = expand(config, parse_axes(config, ["model.start=0.0,0.5"]), [0])
    states = sweep.run_sweep(grid, Choice(number=1), tmp_path / "grid", tmp_path)
    assert list(states.values()) == ["finished"]
    table = next((tmp_path / "grid").glob("*.md")).read_text()
    assert "model.start" in table
    assert "brightness drift, levels ↓" in table


def test_a_weight_of_zero_switches_a_term_off(config: Config) -> None:
    assert config.model.loss_weights == {"error": 1.0}
    assert replace(config.model, error_weight=0.0).loss_weights == {}  # type: ignore[call-arg]


def test_a_metric_of_a_taken_name_is_refused(drift: None) -> None:
    with pytest.raises(UserError, match="two metrics are named 'drift'"):
        metric("drift", "again", better="lower")(lambda scene: np.zeros(1))
