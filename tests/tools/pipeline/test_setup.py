"""From damaged clips to a curriculum of their tokens, with the tokenizer left untrained."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsjax.config import Config, CurriculumStageConfig
from rsjax.data.store import Store, StoreError, encode_clip, open_store, write_store
from rsjax.tokenizers.tokenize import fingerprint
from rsjax.tools.pipeline import stages
from rsjax.tools.pipeline.run import Run, link
from rsjax.tools.pipeline.stages import world_model_loader
from tests.curricula import stage
from tests.tools.pipeline import toy
from tests.tools.pipeline.damage import damage


def with_stages(config: Config, *stages: CurriculumStageConfig) -> Config:
    train = replace(config.train, batch_size=2, curriculum=stages)
    return replace(config, train=train)


def test_tokens_are_labelled_as_their_clips_and_lack_the_damaged_one(tmp_path: Path) -> None:
    run = Run(with_stages(toy.config()), tmp_path / "run", tmp_path / "data")
    clips = toy.store(run.clips)
    damage(clips, "train", 1)
    toy.save_tokenizer(run)
    stages.prepare(run)
    tokens = run.open_prepared()
    assert tokens.path.parent == clips.path.resolve() / "tokens"
    assert tokens.manifest["tokenizer"] == fingerprint(toy.tokenizer_params())
    source = tokens.source("train")
    assert [source[i]["provenance"]["episode"] for i in range(len(source))] == [0, 2]
    assert tokens.labels("train").counts() == {
        "task": {"drift": 2},
        "difficulty": {"unknown": 2},
        "scene": {"unknown": 2},
    }
    (line,) = (run.directory / "tokens" / "quarantine.jsonl").read_text().splitlines()
    assert '"record": 1' in line
    with pytest.raises(StoreError, match="it has difficulty 'unknown' 2×"):
        world_model_loader(replace(run, config=with_stages(run.config, stage("simple", 2.0))))
    loader = world_model_loader(replace(run, config=with_stages(run.config, stage("unknown", 3.0, tasks=("dri*",)))))
    assert loader.loop.steps == 3
    assert loader.summary() == ["stage 1 of the curriculum: 2 clips, steps 1 to 3"]


@pytest.mark.parametrize(
    ("changes", "noted"),
    [({}, 0), ({"action_mean": [1.0]}, 0), ({"depth_range": [0, 9]}, 1), ({"depth_range": None}, 0)],
)
def test_tokens_of_another_store_are_normalized_as_the_runs_own(
    changes: dict[str, Any], noted: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run(with_stages(toy.config(), stage(store=str(tmp_path / "other"))), tmp_path / "run", tmp_path / "data")
    small_store(tmp_path / "own", {})
    other = small_store(tmp_path / "other", changes)
    run.output("tokens").parent.mkdir(parents=True)
    link(tmp_path / "own", run.output("tokens"))
    loader = world_model_loader(run)
    (component,) = loader.stages[0].components
    made = component.transform(other.source("train")[0], np.random.default_rng(0))
    np.testing.assert_allclose(made["actions"], np.array([[0], [0.25], [1.25]]))
    assert capsys.readouterr().out.count("the model does not see the difference") == noted


def small_store(path: Path, changes: dict[str, Any]) -> Store:
    meta = {"action_mean": [0.5], "action_std": [2.0], "depth_range": [0.5, 2.0]}
    grid, actions = np.zeros((3, 2, 2), np.int32), np.array([[0], [1], [3]], np.float32)
    record = {"rgb": grid, "depth": grid, "actions": actions, "tracks": grid, "visible": grid}
    write_store(path, "tokens", {"train": [record]}, meta | changes)
    return open_store(path)


def test_a_mistyped_stage_is_an_error_before_the_tokenizer_is_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(with_stages(toy.config(), stage("hard")), tmp_path / "run", tmp_path / "data")
    write_store(
        run.clips, "clips", {"train": [encode_clip(toy.clip(0))]}, {}, lambda clip: {"task": "", "difficulty": "simple"}
    )
    monkeypatch.setattr(stages, "fit", lambda *_, **__: pytest.fail("it was trained"))
    with pytest.raises(StoreError, match="no train record has a difficulty like hard"):
        stages.train_tokenizer(run, resume=True)
