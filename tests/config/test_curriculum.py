"""Stages of a curriculum on the command line, in a stored configuration, and in content keys."""

import dataclasses
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.cli import parse
from rsjax.config import (
    ComponentConfig,
    Config,
    ConfigError,
    CurriculumStageConfig,
    LoopConfig,
    content_key,
    from_dict,
    presets,
    to_dict,
)
from rsjax.config.curriculum import format_stage, parse_stage

WORDS = st.text("abz *[]?_ -", min_size=1).filter(lambda word: word != "all")
POSITIVE = st.floats(1e-6, 1e6)
PARTS = st.builds(
    ComponentConfig,
    tasks=st.lists(WORDS, min_size=1).map(tuple),
    difficulties=st.lists(WORDS, min_size=1).map(tuple),
    scenes=st.lists(WORDS, min_size=1).map(tuple),
    store=st.sampled_from(["", "runs/b/tokens/store", "/data/a=b"]),
    weight=POSITIVE,
    clips=st.integers(0, 1000),
)
STAGES = st.builds(CurriculumStageConfig, st.lists(PARTS, min_size=1).map(tuple), POSITIVE, st.booleans())


@dataclasses.dataclass(frozen=True)
class NoOptions:
    pass


def read(*argv: str) -> Config:
    return parse(argv, "train", "", NoOptions())[0]


@settings(max_examples=40)
@given(STAGES)
def test_parsing_inverts_formatting(stage: CurriculumStageConfig) -> None:
    assert parse_stage(format_stage(stage)) == stage


@settings(max_examples=20, deadline=None)
@given(st.lists(STAGES, max_size=3).map(tuple))
def test_stages_survive_json_and_change_the_content_key(stages: tuple[CurriculumStageConfig, ...]) -> None:
    loop = LoopConfig(curriculum=stages)
    assert from_dict(LoopConfig, json.loads(json.dumps(to_dict(loop)))) == loop
    assert hash(loop) == hash(dataclasses.replace(loop))
    more = dataclasses.replace(loop, curriculum=(*stages, CurriculumStageConfig()))
    assert content_key(more) != content_key(loop)
    if stages:
        part = dataclasses.replace(stages[0].components[0], weight=stages[0].components[0].weight + 1)
        heavier = dataclasses.replace(stages[0], components=(part, *stages[0].components[1:]))
        changed = dataclasses.replace(loop, curriculum=(heavier, *stages[1:]))
        assert content_key(changed) != content_key(loop)


def test_the_papers_curriculum_on_the_command_line() -> None:
    config = read("tiny", "--train.curriculum", "simple:2", "difficult:3", "--train.seed", "3")
    assert config.train == dataclasses.replace(
        presets.get("tiny").train,
        seed=3,
        curriculum=(
            CurriculumStageConfig((ComponentConfig(difficulties=("simple",)),), 2.0),
            CurriculumStageConfig((ComponentConfig(difficulties=("difficult",)),), 3.0),
        ),
    )


def test_a_word_can_set_every_field() -> None:
    kitchens = ComponentConfig(("pick*", "place"), ("simple", "hard"), ("kitchen*",), "runs/b", 2.5)
    assert parse_stage("simple,hard/pick*,place/kitchen*=2.5@runs/b+all:0.5:restart") == CurriculumStageConfig(
        (kitchens, ComponentConfig()), 0.5, restart=True
    )


def test_full_size_presets_have_the_authors_curriculum_and_it_can_be_dropped() -> None:
    for name in ("roboscape_s", "roboscape_m", "roboscape_l"):
        assert [format_stage(stage) for stage in presets.get(name).train.curriculum] == ["simple:2", "difficult:3"]
    train = read("roboscape_s", "--train.curriculum", "--train.steps", "9").train
    assert (train.curriculum, train.steps) == ((), 9)
    with pytest.raises(ConfigError, match=r"--train.steps changes nothing, as the epochs of --train.curriculum"):
        read("roboscape_s", "--train.steps", "9")


@pytest.mark.parametrize(
    ("word", "reason"),
    [
        ("simple", "its epochs are missing"),
        ("simple:two", "epochs 'two' is not a number above 0"),
        ("simple:0", "epochs '0' is not a number above 0"),
        ("simple:nan", "epochs 'nan' is not a number above 0"),
        ("simple:2:restrt", "epochs 'restrt' is not a number above 0"),
        ("simple=x:2", "weight 'x' is not a number above 0"),
        ("simple=-1:2", "weight '-1' is not a number above 0"),
        ("simple@:2", "nothing follows its @"),
        ("simple#0:2", "'0' is no number of clips"),
        ("simple#few:2", "'few' is no number of clips"),
        (":2", "a difficulty is empty; write all to match every difficulty"),
        ("simple/:2", "a task is empty"),
        ("simple/all/:2", "a scene is empty"),
        ("simple/all/all/x:2", "'x' follows its scenes"),
        ("simple+:2", "a difficulty is empty"),
    ],
)
def test_an_error_names_the_mistake_and_the_syntax(word: str, reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read("tiny", "--train.curriculum", word)
    assert f"stage '{word}': {reason}" in str(caught.value)
    assert "write DIFFICULTIES[/TASKS[/SCENES]]" in str(caught.value) and "such as simple:2" in str(caught.value)


@pytest.mark.parametrize("stages", [3, "simple:2", [3], [{"parts": 3}], [{"epoch": 3}]])
def test_damaged_stages_are_refused(stages: object) -> None:
    with pytest.raises(ConfigError):
        from_dict(LoopConfig, {"stages": stages})
