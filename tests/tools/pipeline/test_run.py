import json
import os
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rsjax.artifact import MARK, Mark
from rsjax.config import (
    ComponentConfig,
    Config,
    CurriculumStageConfig,
    content_key,
    presets,
    sampling_settings,
    to_dict,
)
from rsjax.config.config_fields import with_values
from rsjax.evaluation.metrics import fvd
from rsjax.tools.pipeline import run as module
from rsjax.tools.pipeline.run import STAGES, TRAINED, Run, RunError
from tests.models.toy_family import ToyConfig

DEBUG = presets.debug()


def changed(path: str, value: Any) -> Config:
    """The preset with one field set, such as ``model.loss.gamma``."""
    return put(DEBUG, path.split("."), value)


def put(config: Any, path: list[str], value: Any) -> Any:
    name, *rest = path
    return replace(config, **{name: put(getattr(config, name), rest, value) if rest else value})


def keys(config: Config) -> dict[str, str]:
    return Run(config, Path("run"), Path("data")).keys()


def make(run: Run, *stages: str) -> None:
    """Finishes stages without doing their work."""
    for stage in stages:
        with run.stage(stage) as folder:
            run.output(stage).parent.mkdir(parents=True, exist_ok=True)
            run.output(stage).write_text("done")
            assert folder == run.directory / stage


def whole_run(place: Path, config: Config = DEBUG) -> Run:
    """A run whose stages are all finished."""
    run = Run(config, place / "run", place / "data")
    run.prepare(overwrite=False)
    make(run, *STAGES)
    return run


@pytest.mark.parametrize(
    ("field", "value", "first"),
    [
        ("sim.seed", 1, "collect"),
        ("sim.episodes", 9, "collect"),
        ("tokenizer.channels", 32, "tokenizer"),
        ("tokenizer_train.entropy_weight", 0.2, "tokenizer"),
        ("model.width", 64, "world_model"),
        ("model.corruption.probability", 0.4, "world_model"),
        ("model.loss.gamma", 4.0, "world_model"),
        ("train.ema", 0.5, "world_model"),
        ("train.curriculum", (CurriculumStageConfig(epochs=2.0),), "world_model"),
        ("model.sample.steps", 3, "evaluation"),
        ("eval.action_draws", 2, "evaluation"),
    ],
)
def test_a_field_changes_the_keys_of_its_stage_and_of_all_after_it(field: str, value: Any, first: str) -> None:
    before, after = keys(DEBUG), keys(changed(field, value))
    assert tuple(before) == STAGES
    different = [stage for stage in STAGES if before[stage] != after[stage]]
    assert different == list(STAGES[STAGES.index(first) :])


def test_with_an_early_stop_keys_know_what_validation_generates() -> None:
    early = with_values(DEBUG, {"train.early_stop": "on", "tokenizer_train.early_stop": "on"})
    changes = {"eval.clips": "tokenizer", "eval.batch_size": "world_model", "model.sample.steps": "world_model"}
    for field, first in changes.items():
        after = keys(with_values(early, {field: 1 if field == "eval.batch_size" else 3}))
        assert next(stage for stage in STAGES if keys(early)[stage] != after[stage]) == first


def test_a_model_without_tokens_has_no_tokenizer_stage_and_does_not_depend_on_its_settings() -> None:
    tokenless, other = (replace(config, model=ToyConfig()) for config in (DEBUG, changed("tokenizer.channels", 32)))
    stages = tuple(stage for stage in STAGES if stage != "tokenizer")
    assert Run(tokenless, Path("run"), Path("data")).stages == tuple(keys(tokenless)) == stages
    assert keys(tokenless) == keys(other)
    assert keys(tokenless)["world_model"] != keys(replace(tokenless, model=ToyConfig(start=0.5)))["world_model"]


def test_every_stages_key_is_its_own() -> None:
    assert len(set(keys(DEBUG).values())) == len(STAGES)


def test_a_stage_is_finished_when_its_work_and_its_output_are_there(tmp_path: Path) -> None:
    run = Run(DEBUG, tmp_path / "run", tmp_path / "data")
    for stage in STAGES:
        assert not run.finished(stage)
        make(run, stage)
        assert run.finished(stage)
        run.output(stage).unlink()
        assert not run.finished(stage), "its output was deleted"
    make(run, "evaluation")
    assert not Run(changed("model.sample.steps", 3), run.directory, run.data_directory).finished("evaluation")


def test_an_interrupted_stage_is_not_finished_and_its_seconds_add_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    run = Run(DEBUG, tmp_path, tmp_path)
    run.output("tokenizer").mkdir(parents=True)

    def interrupted() -> None:
        with run.stage("tokenizer"):
            assert run.mark("tokenizer") == Mark(run.keys()["tokenizer"], finished=False, seconds=0.0)
            clock[0] = 5.0
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not run.finished("tokenizer")
    assert run.seconds("tokenizer") == 5.0
    with run.stage("tokenizer"):
        clock[0] = 7.0
    assert run.finished("tokenizer")
    assert run.seconds("tokenizer") == 7.0
    with Run(changed("tokenizer.channels", 32), tmp_path, tmp_path).stage("tokenizer"):
        clock[0] = 8.0
    assert run.seconds("tokenizer") == 1.0, "another configuration's seconds do not count"


def test_another_configurations_training_is_refused_by_name_and_nothing_changes(tmp_path: Path) -> None:
    run = whole_run(tmp_path)
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    other = Run(changed("model.width", 64), run.directory, run.data_directory)
    with pytest.raises(
        RunError, match=r"a world model of another .* \(model.width is 32 there, 64 here\); .*--overwri"
    ):
        other.prepare(overwrite=False)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == files


@pytest.mark.parametrize(
    ("field", "value", "removed"),
    [
        ("model.width", 64, ["world_model"]),
        ("tokenizer.channels", 32, list(TRAINED)),
        ("model.sample.steps", 3, []),
    ],
)
def test_overwrite_removes_the_trained_stages_that_differ_and_no_more(
    tmp_path: Path, field: str, value: Any, removed: list[str]
) -> None:
    run = whole_run(tmp_path)
    other = Run(changed(field, value), run.directory, run.data_directory)
    other.prepare(overwrite=True)
    assert [stage for stage in STAGES if not (run.directory / stage).exists()] == removed
    assert json.loads((run.directory / "config.json").read_text()) == to_dict(other.config)


def test_a_run_is_resumed_though_how_it_is_carried_out_differs(tmp_path: Path) -> None:
    run = whole_run(tmp_path)
    otherwise = replace(
        DEBUG.runtime,
        checkpoint_every=9,
        eval_every=5,
        sharding="mesh",
        wandb="robots",
        workers=2,
        profile=3,
    )
    config = replace(changed("train.accumulate", 2), runtime=otherwise)
    other = Run(config, run.directory, run.data_directory)
    other.prepare(overwrite=False)
    assert all(other.finished(stage) for stage in STAGES)


def test_only_fields_that_change_the_refused_stage_are_named_down_to_those_of_a_curriculum(tmp_path: Path) -> None:
    two = replace(
        DEBUG.train,
        curriculum=(
            CurriculumStageConfig(),
            CurriculumStageConfig((ComponentConfig(difficulties=("simple",)),), epochs=2.0),
        ),
    )
    run = whole_run(tmp_path, replace(DEBUG, train=two))
    changes = replace(two.curriculum[1], epochs=3.0, restart=True)
    loop = replace(two, curriculum=(two.curriculum[0], changes), accumulate=2, ema=0.3)
    runtime = replace(DEBUG.runtime, log_every=77)
    config = replace(changed("model.sample.steps", 3), train=loop, runtime=runtime)
    with pytest.raises(RunError) as error:
        Run(config, run.directory, run.data_directory).prepare(overwrite=False)
    named = re.search(r"of another configuration \((.*)\);", str(error.value))
    assert named and set(named[1].split("; ")) == {
        "train.curriculum.1.epochs is 2.0 there, 3.0 here",
        "train.curriculum.1.restart is False there, True here",
        f"train.ema is {two.ema} there, 0.3 here",
    }


def test_a_field_that_one_side_does_not_have_is_named(tmp_path: Path) -> None:
    run = whole_run(tmp_path)
    longer = Run(changed("train.curriculum", (CurriculumStageConfig(),)), run.directory, run.data_directory)
    with pytest.raises(RunError, match=r"train.curriculum.0.epochs is not set there, 1.0 here"):
        longer.prepare(overwrite=False)


def test_a_mark_of_older_code_is_refused_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run(DEBUG, tmp_path, tmp_path)
    run.prepare(overwrite=False)
    make(run, "tokenizer")
    monkeypatch.setattr(module, "RECIPE", module.RECIPE + 1)
    with pytest.raises(RunError, match="older code"):
        run.prepare(overwrite=False)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(RunError, match="config.json is missing or damaged"):
        run.prepare(overwrite=False)


@pytest.mark.parametrize("mark", [None, "{"])
def test_checkpoints_without_a_mark_are_of_the_configuration_beside_them(tmp_path: Path, mark: str | None) -> None:
    run = Run(DEBUG, tmp_path, tmp_path)
    run.prepare(overwrite=False)
    make(run, "tokenizer")
    (tmp_path / "tokenizer" / "checkpoints").mkdir()
    path = tmp_path / "tokenizer" / MARK
    path.unlink() if mark is None else path.write_text(mark)
    run.prepare(overwrite=False)
    other = Run(changed("tokenizer_train.seed", 9), tmp_path, tmp_path)
    with pytest.raises(RunError, match=r"tokenizer_train.seed is 0 there, 9 here"):
        other.prepare(overwrite=False)
    (tmp_path / "config.json").unlink()
    with pytest.raises(RunError, match="config.json is missing or damaged"):
        run.prepare(overwrite=False)


def test_killed_while_it_overwrites_it_leaves_nothing_to_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, other = (Run(config, tmp_path, tmp_path) for config in (DEBUG, changed("tokenizer.channels", 32)))
    run.prepare(overwrite=False)
    make(run, "tokenizer")

    def killed(path: Path, ignore_errors: bool = False) -> None:
        if path.exists():
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module.shutil, "rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            other.prepare(overwrite=True)
    assert not (tmp_path / "tokenizer").exists()
    other.prepare(overwrite=False)
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]


def test_files_of_weights_enter_the_key_by_their_content(tmp_path: Path) -> None:
    def key(name: str) -> str:
        return keys(changed("eval.weights", str(tmp_path / name)))["evaluation"]

    for name in ("one", "two", "empty"):
        (tmp_path / name).mkdir()
    (tmp_path / "one" / fvd.FILE).write_bytes(b"1")
    (tmp_path / "two" / fvd.FILE).write_bytes(b"1")
    first = key("one")
    assert key("two") == first != key("empty")
    (tmp_path / "one" / fvd.FILE).write_bytes(b"2")
    os.utime(tmp_path / "one" / fvd.FILE, (1, 1))  # the clock of a file system may be too coarse for two writes
    assert first != key("one") != keys(DEBUG)["evaluation"]


def test_without_files_of_weights_the_key_is_that_of_the_settings() -> None:
    before = keys(DEBUG)["world_model"]
    settings = (sampling_settings(DEBUG.model), DEBUG.eval)
    assert keys(DEBUG)["evaluation"] == content_key(module.RECIPE, "evaluation", before, *settings)
