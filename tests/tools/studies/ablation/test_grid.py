import json
import os
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.config import ConfigError, presets
from rsjax.config.config_fields import config_fields, with_values
from rsjax.tools.studies.ablation.grid import (
    SEED,
    SWITCHES,
    WEIGHTS,
    Choice,
    Grid,
    add_cells,
    cell_name,
    chosen_grid,
    expand,
    merge,
    parse_axes,
    parse_value,
    read_grid,
    repeated_cells,
    values_of,
)
from tests.tools.studies.ablation import toy

DEBUG = presets.debug()
VALUES = {
    "model.depth": st.sampled_from(["branch", "head", "none"]),
    "model.loss.keypoints": st.sampled_from(["none", "printed", "difference"]),
    "model.loss.depth_weight": st.floats(0, 10),
    "model.loss.gamma": st.floats(0, 100),
    "model.loss.num_keypoints": st.integers(1, DEBUG.sim.tracks),
    "model.sample.unmask": st.sampled_from(["random", "greedy"]),
    "train.start_from": st.text("ab /é|,=", max_size=4).map(lambda text: f"x{text.replace(',', '')}".strip()),
}
grids = st.lists(st.sampled_from(sorted(VALUES)), unique=True, max_size=3).flatmap(
    lambda names: st.fixed_dictionaries({n: st.lists(VALUES[n], min_size=1, max_size=3, unique=True) for n in names})
)
seeds = st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=3, unique=True)


@settings(max_examples=15)
@given(grids, seeds)
def test_every_combination_is_there_once_in_order_and_is_what_it_says(
    grid: dict[str, list[Any]], seeds: list[int]
) -> None:
    axes = parse_axes(DEBUG, [f"{name}={','.join(map(str, values))}" for name, values in grid.items()])
    found = expand(DEBUG, axes, seeds)
    assert found.fields == tuple(grid)
    expected = list(product(seeds, *grid.values()))
    assert len(found.cells) == len(set(found.cells.values())) == len(expected)
    others = [name for name in config_fields(DEBUG) if name not in (*grid, SEED)]
    for config, values in zip(found.cells.values(), expected, strict=True):
        assert tuple(values_of(config, (SEED, *grid)).values()) == values
        assert values_of(config, others) == values_of(DEBUG, others)


@given(st.dictionaries(st.sampled_from(sorted(VALUES)), st.text(max_size=80), min_size=1), st.integers(0, 9))
def test_names_are_safe_for_file_systems(values: dict[str, str], seed: int) -> None:
    name = cell_name(values, seed)
    assert name.isascii() and len(name) < 200
    assert os.sep not in name and not set(name) & set("\0 *?[]'\"$;|&<>()\\`\n")
    assert name not in (".", "..") and not name.startswith(("-", "."))


def test_names_that_had_to_be_changed_stay_apart() -> None:
    assert cell_name({"a": "x/y"}, 0) != cell_name({"a": "x y"}, 0) != cell_name({"a": "x-y"}, 0)
    assert cell_name({"a": "x" * 300}, 0) != cell_name({"a": "x" * 301}, 0)
    assert (
        cell_name({"model.loss.gamma": 5.0, "model.depth": "head"}, 3) == "model.loss.gamma=5.0,model.depth=head,seed=3"
    )


def test_without_axes_there_is_a_cell_per_seed() -> None:
    assert list(toy.grid(seeds=(4, 2)).cells) == ["seed=4", "seed=2"]


def test_the_grid_of_physics_is_how_depth_is_used_by_the_keypoint_term() -> None:
    models = [*map(toy.roboscape, chosen_grid(presets.roboscape_tiny(), ["physics"], [0]).cells.values())]
    ways = ("none", "branch", "head")
    terms = ("none", "printed", "difference", "motion")
    assert [(m.depth.kind, m.loss.keypoints) for m in models] == list(product(ways, terms))
    assert [m.loss.attention_weight for m in models] == [1.0, 1.0, 0.0, 0.0] * 3, "Eq. 7 belongs to the printed terms"


def test_the_grid_of_weights_varies_one_field_at_a_time_in_equal_ratios() -> None:
    tiny = presets.roboscape_tiny()
    grid = chosen_grid(tiny, ["weights"], [0, 1])
    usual = values_of(tiny, grid.fields)
    changed = [
        [field for field, value in values_of(config, grid.fields).items() if value != usual[field]]
        for config in grid.cells.values()
        if config.train.seed == 1
    ]
    assert changed == [[]] + [[field] for field in grid.fields for _ in range(4)]
    for field, values in parse_axes(tiny, WEIGHTS).items():
        steps = np.diff(np.log(np.array(values, float)))
        assert np.all(np.abs(steps - np.log(3)) < 0.11) or np.allclose(steps, np.log(2)), field
        assert usual[field] in values


def test_the_named_fields_exist() -> None:
    assert set(SWITCHES) | set(SWITCHES.values()) | {SEED} <= set(config_fields(DEBUG))


def test_a_value_as_printed_is_read_back() -> None:
    for name, field in config_fields(DEBUG).items():
        if field.value is not None and not isinstance(field.value, tuple):
            value = parse_value(name, field.kind, str(field.value))
            assert (value, type(value)) == (field.value, type(field.value)), name


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("tokenizer.local_codes", "Tru", "is 'Tru' in the grid; did you mean 'True'? (choices: True, False)"),
        ("model.depth", "heads", "is 'heads' in the grid; did you mean 'head'? (choices: branch, small_branch, head"),
        ("model.sample.unmask", "greed", "did you mean 'greedy'? (choices: random, greedy)"),
        ("model.loss.gamma", "five", "model.loss.gamma is 'five' in the grid; it takes a number"),
        ("model.loss.gamma", "nan", "it takes a number"),
        ("model.loss.num_keypoints", "8.5", "it takes a whole number"),
        ("tokenizer.channel_multipliers", "1", "takes several values"),
    ],
)
def test_a_value_of_another_type_is_refused(name: str, text: str, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_value(name, config_fields(DEBUG)[name].kind, text)
    assert line in str(caught.value)


@pytest.mark.parametrize(
    ("texts", "line"),
    [
        (["loss.gama=1"], "no field 'loss.gama'; did you mean 'model.loss.gamma'?"),
        (["gamma=1"], "did you mean 'model.loss.gamma'?"),
        (["model.loss.gamma"], "write FIELD=VALUE,VALUE"),
        (["model.loss.gamma="], "write FIELD=VALUE,VALUE"),
        (["model.loss.gamma=1,1.0"], "a value is repeated"),
        (["model.loss.gamma=1", "--model.loss.gamma=2"], "model.loss.gamma has an axis already"),
        (["train.seed=1,2"], "seeds have their own option, --seeds 1 2"),
        (["name=a"], "the preset's name has no effect"),
        (["model.loss.num-keypoints=1,x"], "model.loss.num_keypoints is 'x' in the grid; it takes a whole number"),
    ],
)
def test_each_mistake_in_an_axis_gets_a_line(texts: list[str], line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_axes(DEBUG, texts)
    assert line in str(caught.value)


def test_cells_that_cannot_run_are_named_before_any_runs() -> None:
    with pytest.raises(ConfigError) as caught:
        toy.grid("train.batch_size=2,3", "train.accumulate=1,2")
    line = "1 of 4 cells cannot run; the first is train.batch_size=3,train.accumulate=2,seed=0: batch_size 3 does not"
    assert line in str(caught.value)


def test_seeds_are_distinct_in_range_and_a_thousand_at_most() -> None:
    for seeds in ((), (1, 1), (-1,), (2**32,), tuple(range(1001))):
        with pytest.raises(ConfigError, match="--seeds"):
            toy.grid(seeds=seeds)


def test_a_weight_of_a_term_that_is_off_is_reported() -> None:
    gamma, switch = "model.loss.gamma", "model.loss.keypoints"
    assert repeated_cells(toy.grid(f"{gamma}=4,5", f"{switch}=printed,none")) == [
        f"{gamma} has no effect where {switch} is none; cells that differ in it alone are the same"
    ]
    assert repeated_cells(toy.grid("model.loss.depth_weight=1,2", "model.depth=head,none")) == [
        "model.loss.depth_weight has no effect where model.depth is none; cells that differ in it alone are the same"
    ]
    assert not repeated_cells(toy.grid("model.loss.gamma=4,5", "model.depth=branch,none"))


def test_cells_are_chosen_by_number_name_and_pattern() -> None:
    names = list(toy.grid("model.depth=branch,head,none", "model.loss.keypoints=printed,none", seeds=(0, 1)).cells)
    assert list(Choice().of(names)) == names
    assert list(Choice(number=3).of(names)) == [names[3]]
    assert list(Choice(only=("*seed=1", names[0])).of(names)) == [names[0], *names[6:]]
    assert list(Choice(only=("*seed=1",), skip=("model.depth=branch,*",)).of(names)) == names[8:]
    assert Choice(number=0, only=("*seed=1",)).of(names) == ()
    for choice, line in (
        (Choice(number=12), "cell 12 is not in this grid; its cells are 0 … 11"),
        (Choice(only=(names[0].replace("br", "b"),)), f"did you mean '{names[0]}'"),
        (Choice(skip=("seed",)), "--skip seed: no such cell"),
    ):
        with pytest.raises(ConfigError) as caught:
            choice.of(names)
        assert line in str(caught.value)


def add(out: Path, grid: Grid) -> tuple[str, ...]:
    return add_cells(out, grid, Choice())[1]


def test_a_grid_is_read_as_it_was_written(tmp_path: Path) -> None:
    assert read_grid(tmp_path) is None
    grid = toy.grid("model.loss.gamma=4,5", "model.sample.unmask=greedy", seeds=(0, 7))
    assert add(tmp_path, grid) == tuple(grid.cells)
    assert read_grid(tmp_path) == grid
    assert grid.fields == ("model.loss.gamma", "model.sample.unmask")
    assert json.loads((tmp_path / "grid.json").read_text())["versions"]["jax"]


def test_a_grid_over_sections_is_read_as_it_was_written_and_grows(tmp_path: Path) -> None:
    base = with_values(DEBUG, {"model.depth": "head", "model.depth.feed_back": False})
    grid = toy.grid("model.depth=none,head", base=base)
    add(tmp_path, grid)
    assert read_grid(tmp_path) == grid
    names = add(tmp_path, toy.grid("model.depth=head,small_branch", base=base))
    assert names == ("model.depth=head,seed=0", "model.depth=small_branch,seed=0")
    before = (tmp_path / "grid.json").read_bytes()
    with pytest.raises(ConfigError) as refused:
        add(tmp_path, toy.grid("model.depth=none,head", seeds=(0, 1)))
    line = "another configuration (model.depth.feed_back is False there, True here); choose another --out"
    assert line in str(refused.value) and (tmp_path / "grid.json").read_bytes() == before
    small = with_values(DEBUG, {"model.depth": "small_branch"})
    with pytest.raises(ConfigError) as refused:
        toy.grid("model.depth=small_branch,head", "model.depth.width=32,64", base=small)
    assert "cells cannot run" in str(refused.value)


def test_more_values_fields_and_seeds_add_cells_and_keep_those_there_are(tmp_path: Path) -> None:
    first = toy.grid("model.depth=branch,none")
    add(tmp_path, first)
    names = add(tmp_path, toy.grid("model.loss.gamma=4,5", seeds=(0, 1)))
    assert names[0] == "model.depth=branch,model.loss.gamma=4.0,seed=0"
    assert names[1] == "model.depth=branch,seed=0", "γ is 5 already: that cell is there"
    grid = read_grid(tmp_path)
    assert grid is not None
    assert list(grid.cells) == ["model.depth=branch,seed=0", "model.depth=none,seed=0", names[0], *names[2:]]
    assert list(grid.cells.values())[:2] == list(first.cells.values())
    assert grid.fields == ("model.depth", "model.loss.gamma")
    assert len(set(grid.cells.values())) == len(grid.cells) == 5


def test_cells_of_several_bases_keep_their_values_and_names_apart(tmp_path: Path) -> None:
    """A field that was varied may differ in the configuration; each cell still has the value it was made with."""
    add(tmp_path, toy.grid("model.loss.gamma=4,5"))
    for gamma in (6.0, 7.0):
        base = with_values(DEBUG, {"model.loss.gamma": gamma})
        add(tmp_path, toy.grid("model.depth=branch", base=base))
    grid = read_grid(tmp_path)
    assert grid is not None
    assert [toy.roboscape(config).loss.gamma for config in grid.cells.values()] == [4.0, 5.0, 6.0, 7.0]


def test_how_runs_are_carried_out_and_the_seed_may_differ(tmp_path: Path) -> None:
    base = replace(DEBUG, train=replace(DEBUG.train, seed=9), runtime=replace(DEBUG.runtime, log_every=1))
    grid, names = merge(toy.grid("model.loss.gamma=4"), toy.grid("model.loss.gamma=4", base=base), tmp_path)
    assert list(grid.cells) == list(names)


def test_other_versions_of_the_libraries_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid = toy.grid("model.loss.gamma=4")
    add(tmp_path, replace(grid, versions={"jax": "0.1"}))
    assert not capsys.readouterr().out
    add(tmp_path, grid)
    assert "earlier cells may be of other versions (jax 0.1; now rsjax" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("text", ["{", "{}", '{"config": {"name": "x", "nonsense": 1}}', "[]"])
def test_a_damaged_file_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "grid.json").write_text(text)
    with pytest.raises(ConfigError, match=r"grid.json: damaged or of another version .* --out"):
        read_grid(tmp_path)
