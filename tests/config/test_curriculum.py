"""Curricula on the command line, in a stored configuration, and in content keys."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.config import (
    ComponentConfig,
    Config,
    ConfigError,
    CurriculumStageConfig,
    TrainConfig,
    content_key,
    from_dict,
    presets,
    to_dict,
)
from rsjax.config.curriculum import read_curriculum, write_curriculum
from rsjax.tools.commands.cli import parse
from tests.curricula import PAPER, mixed, stage

WORDS = st.text(min_size=1, max_size=5)
POSITIVE = st.floats(1e-6, 1e6)
FILTERS = {
    "tasks": st.lists(WORDS, min_size=1).map(tuple),
    "difficulties": st.lists(WORDS, min_size=1).map(tuple),
    "scenes": st.lists(WORDS, min_size=1).map(tuple),
    "weight": POSITIVE,
    "clips": st.integers(0, 1000),
}
PARTS = st.one_of(
    st.builds(ComponentConfig, **FILTERS, store=st.sampled_from(["", "runs/b/tokens/store", "/data/a=b"])),
    st.builds(ComponentConfig, **FILTERS, annotations=st.sampled_from(["estimated_tracks", "estimated"])),
)
STAGES = st.builds(
    CurriculumStageConfig, st.lists(PARTS, min_size=1).map(tuple), POSITIVE, st.booleans(), st.sampled_from([0, 2, 9])
)


@dataclasses.dataclass(frozen=True)
class NoOptions:
    pass


def read(*argv: str) -> Config:
    return parse(argv, "train", "", NoOptions())[0]


def test_a_stage_has_a_frame_to_predict() -> None:
    config = dataclasses.replace(presets.get("debug"), prompt_frames=4)
    stages = (CurriculumStageConfig(frames=5), CurriculumStageConfig(frames=4))
    with pytest.raises(ConfigError) as raised:
        dataclasses.replace(config, train=dataclasses.replace(config.train, curriculum=stages))
    assert "takes 4 frames of a clip, of which the first 4 are given (prompt_frames)" in str(raised.value)


@pytest.mark.parametrize(("preset", "frames"), [("debug", 100), ("irasim_tiny", 4)])
def test_frames_that_clips_or_families_do_not_have_are_refused(preset: str, frames: int) -> None:
    config = presets.get(preset)
    stages = (CurriculumStageConfig(frames=frames),)
    with pytest.raises(ConfigError) as raised:
        dataclasses.replace(config, train=dataclasses.replace(config.train, curriculum=stages))
    assert f"a stage of train.curriculum takes {frames} of {config.clips.frames} frames" in str(raised.value)


@settings(max_examples=40)
@given(st.lists(STAGES, max_size=3).map(tuple))
def test_reading_inverts_writing(stages: tuple[CurriculumStageConfig, ...]) -> None:
    assert read_curriculum(write_curriculum(stages)) == stages


@settings(max_examples=20, deadline=None)
@given(st.lists(STAGES, max_size=3).map(tuple))
def test_stages_survive_json_and_change_the_content_key(stages: tuple[CurriculumStageConfig, ...]) -> None:
    train = TrainConfig(curriculum=stages)
    assert from_dict(TrainConfig, json.loads(json.dumps(to_dict(train)))) == train
    assert hash(train) == hash(dataclasses.replace(train))
    more = dataclasses.replace(train, curriculum=(*stages, CurriculumStageConfig()))
    assert content_key(more) != content_key(train)
    if stages:
        part = dataclasses.replace(stages[0].components[0], weight=stages[0].components[0].weight + 1)
        heavier = dataclasses.replace(stages[0], components=(part, *stages[0].components[1:]))
        changed = dataclasses.replace(train, curriculum=(heavier, *stages[1:]))
        assert content_key(changed) != content_key(train)


def test_the_papers_curriculum_on_the_command_line_and_in_a_file(tmp_path: Path) -> None:
    text = '[{"difficulties": ["simple"], "epochs": 2}, {"difficulties": ["difficult"], "epochs": 3}]'
    path = tmp_path / "paper.json"
    path.write_text(text)
    for value in (text, str(path)):
        config = read("tiny", "--train.curriculum", value, "--train.seed", "3")
        assert config.train == dataclasses.replace(presets.get("tiny").train, seed=3, curriculum=PAPER)


def test_an_entry_can_set_every_field() -> None:
    kitchens = {"tasks": ["pick*"], "difficulties": ["simple"], "scenes": ["kitchen*"], "store": "runs/b", "clips": 9}
    whole = stage(
        "simple", 0.5, restart=True, tasks=("pick*",), scenes=("kitchen*",), store="runs/b", weight=2.5, clips=9
    )
    entry = kitchens | {"weight": 2.5, "epochs": 0.5, "restart": True, "frames": 4}
    assert read_curriculum(json.dumps([entry])) == (dataclasses.replace(whole, frames=4),)
    assert read_curriculum('[{"annotations": "estimated"}]') == (stage(annotations="estimated"),)
    components = [{"difficulties": ["a"], "weight": 1.0}, {"difficulties": ["b"], "weight": 2.0}]
    assert read_curriculum(json.dumps([{"components": components}])) == (mixed({"a": 1.0, "b": 2.0}),)


def test_full_size_presets_have_the_authors_curriculum_and_it_can_be_dropped() -> None:
    for name in ("roboscape_s", "roboscape_m", "roboscape_l"):
        assert presets.get(name).train.curriculum == PAPER
    train = read("roboscape_s", "--train.curriculum", "[]", "--train.steps", "9").train
    assert (train.curriculum, train.steps) == ((), 9)
    with pytest.raises(ConfigError, match=r"--train.steps changes nothing, as the epochs of --train.curriculum"):
        read("roboscape_s", "--train.steps", "9")


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("[", "not JSON"),
        ("absent.json", "absent.json"),
        ([3], "stage 1 of the curriculum: not fields by name but 3"),
        ([{}, {"epoch": 3}], "stage 2 of the curriculum: CurriculumStageConfig has no field epoch"),
        ([{"epochs": "two"}], "CurriculumStageConfig.epochs must be a number; it is 'two'"),
        ([{"epochs": 0}], "a curriculum's stage has 0.0 epochs"),
        ([{"components": []}], "a curriculum's stage has no components"),
        ([{"components": [{}], "tasks": ["a"]}], "tasks stand beside components"),
        ([{"components": 3}], "CurriculumStageConfig.components must be a list"),
        ([{"annotations": "estimated", "store": "elsewhere"}], "annotations estimated and a store"),
        ([{"tasks": "pick"}], "ComponentConfig.tasks must be a list; it is 'pick'"),
        ([{"weight": -1}], "a component of a data mixture has weight -1"),
        ([{"clips": -1}], "a component of a data mixture has -1 clips"),
    ],
)
def test_a_mistake_is_named(value: Any, reason: str) -> None:
    text = value if isinstance(value, str) else json.dumps(value)
    with pytest.raises(Exception) as caught:  # noqa: PT011 - of the command, by its message
        read("tiny", "--train.curriculum", text)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


def test_damaged_stages_of_a_stored_configuration_are_refused() -> None:
    for stages in (3, "simple:2", [3], [{"components": 3}], [{"epoch": 3}]):
        with pytest.raises(ConfigError, match="CurriculumStageConfig|curriculum"):
            from_dict(TrainConfig, {"curriculum": stages})
