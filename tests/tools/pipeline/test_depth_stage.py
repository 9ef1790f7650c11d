"""The stage that trains the depth estimator ``simulator``, on a run's own clips."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsjax.artifact import make_once
from rsjax.config import Config, ConfigError, DataConfig, EvalConfig, NoDepth
from rsjax.config.config_fields import with_values
from rsjax.data.store import StoreError
from rsjax.evaluation.evaluate import evaluate
from rsjax.tools.pipeline.depth_stage import check_depth, depth_estimator, make_depth_network
from rsjax.tools.pipeline.metric_files import by_content, load_estimator
from rsjax.tools.pipeline.run import Run
from tests.tools.pipeline import toy


def config(clips: Path, steps: int = 2) -> Config:
    base = toy.config()
    shape = base.sim.clips
    data = DataConfig(store=str(clips), key="toy", **{name: getattr(shape, name) for name in vars(shape)})
    return with_values(replace(base, data=data), {"eval.depth_estimator": f"simulator:steps={steps}"})


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("depth")
    toy.store(folder / "clips")
    return Run(config(folder / "clips"), folder / "run", folder)


def test_a_folder_that_was_emptied_is_filled_once_for_all_runs_on_the_same_clips(run: Run) -> None:
    with make_once(run.output("depth_estimator"), run.keys()["depth_estimator"], refuse=None):
        pass  # finished, and the weights are gone
    first = depth_estimator(run)
    weights = run.output("depth_estimator") / "weights"
    made = weights.stat().st_mtime_ns
    genie = Run(run.config.with_family("genie"), run.directory.with_name("genie"), run.data_directory)
    second = depth_estimator(genie)
    assert first is not None and second is not None
    frames = toy.clip(0).rgb
    np.testing.assert_array_equal(first(frames).maps, second(frames).maps)
    assert weights.stat().st_mtime_ns == made
    assert genie.output("depth_estimator") == run.output("depth_estimator")


def test_other_clips_or_steps_need_another_estimator(run: Run) -> None:
    assert run.config.data is not None
    longer = replace(run, config=with_values(run.config, {"eval.depth_estimator": "simulator"}))
    elsewhere = replace(run, config=replace(run.config, data=replace(run.config.data, key="other")))
    assert len({each.output("depth_estimator") for each in (run, longer, elsewhere)}) == 3


def test_the_stage_stands_before_evaluation_where_it_is_asked_for(run: Run) -> None:
    assert run.stages[-3:] == ("depth_estimator", "evaluation", "report")
    without = replace(run, config=with_values(run.config, {"eval.depth_estimator": ""}))
    assert "depth_estimator" not in without.stages
    assert depth_estimator(without) is None
    same = run.keys().keys() & without.keys().keys() - {"evaluation", "report"}
    assert {name: run.keys()[name] for name in same} == {name: without.keys()[name] for name in same}
    assert run.keys()["evaluation"] != without.keys()["evaluation"]


def test_all_models_get_depth_scores_and_the_estimators_own_error(run: Run) -> None:
    blind = toy.with_model(run.config, depth=NoDepth())
    found = evaluate(toy.trained(run.open_clips(), blind), run.open_clips(), estimator=depth_estimator(run))
    for measure in ("absrel", "delta1", "delta2"):
        names = [f"depth_{measure}_exact_estimator{part}" for part in ("", "_repeat_first", "_tokenizer", "_truth")]
        assert np.isfinite([found.metrics[name] for name in (*names, f"depth_{measure}_median_estimator")]).all()
        assert f"depth_{measure}_exact_estimator_tokenizer_truth" not in found.metrics
        assert len(found.curves[f"depth_{measure}_exact_estimator"]) == run.config.clips.frames - 1


def test_clips_without_depth_are_refused_before_anything_is_trained(tmp_path: Path) -> None:
    toy.store(tmp_path / "clips", depth=False)
    blind = Run(config(tmp_path / "clips"), tmp_path / "run", tmp_path)
    for work in (check_depth, make_depth_network):
        with pytest.raises(StoreError) as caught:
            work(blind)
        assert "its clips have no depth in metres, from which the depth estimator simulator would learn" in str(
            caught.value
        )


@pytest.mark.parametrize("word", ["simulator:", "simulator:steps=0", "simulator:step=3", "simulators", "simulator:3"])
def test_a_word_that_is_not_understood_is_refused_with_the_right_one(word: str) -> None:
    with pytest.raises(ConfigError) as caught:
        EvalConfig(depth_estimator=word)
    assert f"eval.depth_estimator is {word!r}; write simulator or simulator:steps=500" in str(caught.value)


def test_the_setting_is_known_by_its_steps() -> None:
    named = [by_content(EvalConfig(depth_estimator=word)) for word in ("simulator", "simulator:steps=2000")]
    assert named[0] == named[1] != by_content(EvalConfig(depth_estimator="simulator:steps=3"))
    assert load_estimator(EvalConfig(depth_estimator="simulator")) is None
