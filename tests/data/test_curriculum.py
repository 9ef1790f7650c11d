import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.config import ClipShape, ComponentConfig, CurriculumStageConfig, LoopConfig
from rsjax.data.curriculum import check_stages, choose, first_frames, loader_factory
from rsjax.data.state_labels import state_labels
from rsjax.data.store import Store, StoreError, open_store, write_store
from rsjax.models.roboscape.records import random_record
from tests.curricula import PAPER, mixed, stage
from tests.data import toy
from tests.data.toy import assert_same, jitter, take

COUNT = 30
EVERYTHING = stage()
SIMPLE = stage("simple")
MEANT = {"pick*": {"pick up", "pick out"}, "*": set(toy.TASKS)} | {task: {task} for task in toy.TASKS}


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return toy.store(tmp_path_factory.mktemp("curriculum") / "own", COUNT, tokenizer="a")


def loop(*stages: CurriculumStageConfig, **fields: Any) -> LoopConfig:
    return LoopConfig(batch_size=4, curriculum=stages, **fields)


@given(st.sets(st.sampled_from(sorted(MEANT))), st.sets(st.sampled_from(toy.DIFFICULTIES)))
def test_a_filter_by_labels_is_a_filter_by_reading_every_record(
    own: Store, tasks: set[str], difficulties: set[str]
) -> None:
    source = own.source("train")
    meant = {task for pattern in tasks for task in MEANT[pattern]}
    expected = [i for i in range(COUNT) if source[i]["task"] in meant and source[i]["difficulty"] in difficulties]
    part = ComponentConfig(tasks=tuple(tasks), difficulties=tuple(difficulties))
    if expected:
        chosen = choose(part, own)
        assert chosen is not None and chosen.tolist() == expected
    else:
        with pytest.raises(StoreError, match="no train record"):
            choose(part, own)


def test_a_number_of_clips_takes_the_first_that_pass(own: Store) -> None:
    everything, simple = choose(ComponentConfig(clips=7), own), ComponentConfig(difficulties=("simple",))
    assert everything is not None and everything.tolist() == list(range(7))
    all_of_them, few = choose(simple, own), choose(replace(simple, clips=3), own)
    assert all_of_them is not None and few is not None and few.tolist() == all_of_them[:3].tolist()
    enough = choose(ComponentConfig(clips=COUNT + 5), own)
    assert enough is not None and len(enough) == COUNT
    assert loader_factory(loop(stage(epochs=3.0, clips=8)), own, jitter, own.path).loop.steps == 8 * 3 // 4


def test_an_empty_filter_lists_what_there_is(own: Store) -> None:
    for check in (
        lambda: check_stages(loop(stage("hard", tasks=("pick*",))), own),
        lambda: loader_factory(loop(stage("hard", tasks=("pick*",))), own, jitter, own.path),
    ):
        with pytest.raises(StoreError) as caught:
            check()
        assert "difficulty like hard and a task like pick*" in str(caught.value)
        assert "difficulty 'difficult' 15×, 'simple' 15×; task 'pick out' 10×, 'pick up' 10×, 'place' 10×" in str(
            caught.value
        )


def test_a_stage_can_choose_scenes_where_the_store_names_them(own: Store, tmp_path: Path) -> None:
    write_store(
        tmp_path / "scenes",
        "numbers",
        {"train": map(toy.record, range(9))},
        {},
        lambda r: {"scene": f"room {r['i'] % 3}"},
    )
    part = ComponentConfig(scenes=("room 1", "room 2"))
    chosen = choose(part, open_store(tmp_path / "scenes"))
    assert chosen is not None and chosen.tolist() == [1, 2, 4, 5, 7, 8]
    with pytest.raises(StoreError, match="its records name no scene, only task, difficulty; make it again"):
        choose(part, own)


@settings(max_examples=30)
@given(
    st.lists(
        st.tuples(st.sampled_from(["simple", "all", "difficult/pick*"]), st.integers(1, 30), st.booleans()), min_size=1
    ),
    st.integers(1, 40),
)
def test_steps_are_epochs_in_whole_batches_and_restarts_the_first_steps(
    own: Store, stages: list[tuple[str, int, bool]], batch_size: int
) -> None:
    """Epochs in tenths, so that no rounding of floats may add a batch."""
    sizes = {"simple": 15, "all": 30, "difficult/pick*": 10}
    parts = {"simple": SIMPLE, "all": EVERYTHING, "difficult/pick*": stage("difficult", tasks=("pick*",))}
    entries = [replace(parts[part], epochs=tenths / 10, restart=restart) for part, tenths, restart in stages]
    steps = [-(-sizes[part] * tenths // (10 * batch_size)) for part, tenths, _ in stages]
    firsts = np.cumsum([0, *steps]).tolist()
    feed = loader_factory(replace(loop(*entries), batch_size=batch_size), own, jitter, own.path)
    planned = feed.loop
    assert planned.steps == sum(steps)
    assert planned.restarts == tuple(f for f, (_, _, restart) in zip(firsts, stages, strict=False) if restart and f)
    assert len(feed.summary()) == len(stages)


def test_the_papers_curriculum_reads_each_simple_clip_twice_and_then_each_difficult_one_three_times(own: Store) -> None:
    feed = loader_factory(replace(loop(*PAPER), batch_size=5), own, jitter, own.path)
    planned = feed.loop
    assert (planned.steps, planned.restarts) == (6 + 9, ())
    with feed(None) as loader:
        taken = take(loader, planned.steps)["i"]
    simple, difficult = np.arange(0, COUNT, 2), np.arange(1, COUNT, 2)
    np.testing.assert_array_equal(np.sort(taken[:6].ravel()), np.repeat(simple, 2))
    np.testing.assert_array_equal(np.sort(taken[6:].ravel()), np.repeat(difficult, 3))
    assert feed.summary() == [
        "stage 1 of the curriculum: 15 clips, steps 1 to 6",
        "stage 2 of the curriculum: 15 clips, steps 7 to 15",
    ]


def test_without_stages_the_loop_stays_and_all_is_read(own: Store) -> None:
    feed = loader_factory(loop(steps=7), own, jitter, own.path)
    plain = feed.loop
    assert plain == loop(steps=7) and feed.summary() == []
    same = loader_factory(loop(EVERYTHING), own, jitter, own.path)
    one = same.loop
    assert one.steps == 8
    with feed(None) as left, same(None) as right:
        assert_same(take(left, 10), take(right, 10))


@settings(max_examples=5)
@given(st.integers(0, 20))
def test_a_batch_is_rebuilt_and_named_from_the_state_before_it_alone(own: Store, number: int) -> None:
    feed = loader_factory(loop(mixed({"simple": 1.0, "difficult": 2.0}), EVERYTHING), own, jitter, own.path)
    with feed(None) as loader:
        for _ in range(number):
            next(loader)
        before = json.loads(json.dumps(loader.state()))
        arrays = next(loader)
        assert_same(feed.replay(before), arrays)
        with loader.whole(before) as again:
            assert again.identify(next(again)) == loader.identify(arrays)


def test_a_mixture_of_two_stores_names_each_clips_own(own: Store, tmp_path: Path) -> None:
    other = toy.store(tmp_path / "other", 6, first=100, tokenizer="a")
    simple = ComponentConfig(difficulties=("simple",))
    parts = (simple, ComponentConfig(store=str(other.path), weight=3.0))
    feed = loader_factory(loop(CurriculumStageConfig(parts)), own, jitter, tmp_path)
    with feed(None) as loader:
        for _ in range(5):
            arrays = next(loader)
            assert (arrays["i"] >= 100).sum() == 3
            names = [Path(row["store"]).name for row in loader.identify(arrays)]
            assert names == ["other" if number >= 100 else "own" for number in arrays["i"]]


def test_stores_that_do_not_go_together_are_refused(own: Store, tmp_path: Path) -> None:
    toy.store(tmp_path / "other", 3, tokenizer="b")
    longer = [toy.record(0) | {"i": np.zeros(2, int)}]
    write_store(tmp_path / "same", "numbers", {"train": longer}, {"tokenizer": "a"})
    for name, message in (
        ("other", "its tokenizer is b, that of .* is a"),
        ("same", r"its i is int64 \(2,\), that of .* is int64 \(\)"),
        ("nothing", "nothing: not there"),
    ):
        with pytest.raises(StoreError, match=message):
            loader_factory(loop(stage(store=f"{tmp_path}/{name}")), own, jitter, tmp_path)


def test_a_store_without_labels_is_read_whole_or_not_at_all(tmp_path: Path) -> None:
    write_store(tmp_path / "old", "numbers", {"train": map(toy.record, range(3))}, {})
    old = open_store(tmp_path / "old")
    assert loader_factory(loop(stage(epochs=4.0)), old, jitter, tmp_path).loop.steps == 3
    check_stages(loop(SIMPLE), old)  # its tokens may have them
    with pytest.raises(StoreError, match="names no task and difficulty"):
        loader_factory(loop(SIMPLE), old, jitter, tmp_path)


def test_damage_is_counted_once_over_stages_and_survives_a_restart(tmp_path: Path) -> None:
    own = toy.store(tmp_path / "own", 10)
    toy.damage(own.path, 4)
    feed = loader_factory(loop(SIMPLE, EVERYTHING, max_damaged=0.1), own, jitter, tmp_path / "stage")
    for _ in range(2):
        with feed(None) as loader:
            assert 4 not in take(loader, 6)["i"]
            assert loader.quarantined() == 1
    (line,) = (tmp_path / "stage" / "quarantine.jsonl").read_text().splitlines()
    assert json.loads(line)["record"] == 4
    strict = loader_factory(loop(SIMPLE, EVERYTHING, max_damaged=0.0), own, jitter, tmp_path / "stage")
    with strict(None) as loader, pytest.raises(StoreError, match="1 of 10 records are damaged"):
        take(loader, 6)


def test_a_stage_of_few_frames_reads_the_first_ones() -> None:
    record = random_record(np.random.default_rng(0), ClipShape(6, 64, 5, 3, 2), grid=4, code_bits=6)
    second = np.arange(6 * 4 * 4).reshape(6, 4, 4)
    objects = {"height": [0.1 * t for t in range(6)], "opening": [0.0] * 6, "cube_width": 3.0}
    record = record | {"depth": None, "second": second, "provenance": record["provenance"] | {"objects": objects}}
    shifted = np.stack([record["rgb"] + 1, record["rgb"] + 2])
    record = record | {"success": np.arange(6) > 2, "rgb_shifted": shifted, "depth_shifted": shifted + 2}
    cut = first_frames(lambda record, rng: record, 4, record, np.random.default_rng(0))
    assert cut["rgb"].tolist() == record["rgb"][:4].tolist()
    assert cut["actions"].tolist() == record["actions"][:4].tolist()
    assert cut["tracks"].tolist() == record["tracks"][:, :4].tolist()
    assert cut["visible"].tolist() == record["visible"][:, :4].tolist()
    assert cut["depth"] is None
    assert cut["second"].tolist() == second[:4].tolist()
    assert cut["rgb_shifted"].tolist() == shifted[:, :4].tolist()
    assert cut["depth_shifted"].tolist() == (shifted + 2)[:, :4].tolist()
    assert state_labels(cut)[:, 0].tolist() == [0, 0, 0, 1]
    np.testing.assert_array_equal(state_labels(cut)[:, 1:], state_labels(record)[:4, 1:])
    assert cut["provenance"]["objects"]["cube_width"] == 3.0 and len(objects["height"]) == 6
    with pytest.raises(StoreError) as caught:
        first_frames(lambda record, rng: record, 7, record, np.random.default_rng(0))
    assert "takes 7 frames" in str(caught.value)
