import os
from itertools import product
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.ablation.fields import GridError, leaves
from rsjax.ablation.grid import DEFAULT_AXES, Choice, cell_name, expand, idle, parse_axes, task_number
from rsjax.config import presets
from tests.ablation import toy

DEBUG = presets.debug()
VALUES = {
    "model.depth": st.booleans(),
    "loss.keypoints": st.booleans(),
    "loss.depth": st.floats(0, 10),
    "loss.gamma": st.floats(0, 100),
    "loss.num_keypoints": st.integers(1, DEBUG.sim.tracks),
    "sample.unmask": st.sampled_from(["random", "greedy"]),
    "train.start_from": st.text("ab /é|,=", max_size=4).map(lambda text: f"x{text.replace(',', '')}".strip()),
}
grids = st.lists(st.sampled_from(sorted(VALUES)), unique=True, max_size=3).flatmap(
    lambda names: st.fixed_dictionaries({n: st.lists(VALUES[n], min_size=1, max_size=3, unique=True) for n in names})
)
seeds = st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=3, unique=True)


@settings(deadline=None, max_examples=60)
@given(grids, seeds)
def test_every_combination_is_there_once_in_order_and_is_what_it_says(
    grid: dict[str, list[Any]], seeds: list[int]
) -> None:
    axes = parse_axes(DEBUG, [f"{name}={','.join(map(str, values))}" for name, values in grid.items()])
    cells = expand(DEBUG, axes, seeds)
    assert [(cell.seed, *cell.values.values()) for cell in cells] == list(product(seeds, *grid.values()))
    assert len({cell.name for cell in cells}) == len(cells)
    assert len({cell.config for cell in cells}) == len(cells)
    for cell in cells:
        found = leaves(cell.config)
        assert {name: found[name].value for name in grid} == dict(cell.values)
        assert cell.config.train.seed == cell.seed
        others = {name: leaf for name, leaf in leaves(DEBUG).items() if name not in (*grid, "train.seed")}
        assert {name: found[name] for name in others} == others


@given(st.dictionaries(st.sampled_from(sorted(VALUES)), st.text(max_size=80), min_size=1), st.integers(0, 9))
def test_names_are_safe_for_file_systems(values: dict[str, str], seed: int) -> None:
    name = cell_name(values, seed)
    assert name.isascii() and len(name) < 200
    assert os.sep not in name and not set(name) & set("\0 *?[]'\"$;|&<>()\\`\n")
    assert name not in (".", "..") and not name.startswith(("-", "."))


def test_names_that_had_to_be_changed_stay_apart() -> None:
    assert cell_name({"a": "x/y"}, 0) != cell_name({"a": "x y"}, 0) != cell_name({"a": "x-y"}, 0)
    assert cell_name({"a": "x" * 300}, 0) != cell_name({"a": "x" * 301}, 0)
    assert cell_name({"loss.gamma": 5.0, "model.depth": True}, 3) == "loss.gamma=5.0,model.depth=True,seed=3"


def test_without_axes_there_is_a_cell_per_seed() -> None:
    assert [cell.name for cell in toy.cells(seeds=(4, 2))] == ["seed=4", "seed=2"]


def test_the_default_is_depth_and_keypoints_on_and_off() -> None:
    cells = toy.cells(*DEFAULT_AXES)
    assert [(c.config.model.depth, c.config.loss.keypoints) for c in cells] == list(product((True, False), repeat=2))


@pytest.mark.parametrize(
    ("texts", "line"),
    [
        (["loss.gama=1"], "no field 'loss.gama'; did you mean 'loss.gamma'?"),
        (["gamma=1"], "did you mean 'loss.gamma'?"),
        (["loss.gamma"], "write FIELD=VALUE,VALUE"),
        (["loss.gamma="], "write FIELD=VALUE,VALUE"),
        (["loss.gamma=1,1.0"], "a value stands twice"),
        (["loss.gamma=1", "--loss.gamma=2"], "loss.gamma has an axis already"),
        (["train.seed=1,2"], "seeds have an option of their own, --seeds 1 2"),
        (["name=a"], "the preset's name changes nothing"),
        (["loss.num-keypoints=1,x"], "loss.num_keypoints is 'x' in the grid; it takes a whole number"),
    ],
)
def test_each_mistake_in_an_axis_gets_a_line(texts: list[str], line: str) -> None:
    with pytest.raises(GridError) as caught:
        parse_axes(DEBUG, texts)
    assert line in str(caught.value)


def test_cells_that_cannot_run_are_named_before_any_runs() -> None:
    with pytest.raises(GridError) as caught:
        toy.cells("loss.num_keypoints=8,65", "loss.keypoints=True,False")
    assert "1 of 4 cells cannot run; the first is loss.num_keypoints=65,loss.keypoints=True,seed=0: " in str(
        caught.value
    )
    assert "only sim.tracks = 64 are tracked" in str(caught.value)


@pytest.mark.parametrize("seeds", [(), (1, 1), (-1,), (2**32,)])
def test_seeds_are_given_once_and_in_range(seeds: tuple[int, ...]) -> None:
    with pytest.raises(GridError, match="--seeds"):
        toy.cells(seeds=seeds)


def test_a_weight_of_a_term_that_is_off_is_told() -> None:
    assert idle(toy.cells("loss.gamma=4,5", "loss.keypoints=True,False")) == [
        "loss.gamma changes nothing where loss.keypoints is False; cells that differ in it alone are the same"
    ]
    assert not idle(toy.cells("loss.gamma=4,5", "model.depth=True,False"))


def test_cells_are_chosen_by_number_name_and_pattern() -> None:
    cells = toy.cells(*DEFAULT_AXES, seeds=(0, 1))
    names = [cell.name for cell in cells]
    assert [c.name for c in Choice().of(cells)] == names
    assert [c.name for c in Choice(number=3).of(cells)] == [names[3]]
    assert [c.name for c in Choice(only=("*seed=1", names[0])).of(cells)] == [names[0], *names[4:]]
    assert [c.name for c in Choice(only=("*seed=1",), skip=("model.depth=True,*",)).of(cells)] == names[6:]
    assert Choice(number=0, only=("*seed=1",)).of(cells) == ()
    for choice, line in (
        (Choice(number=8), "cell 8 is not in this grid, whose cells are 0 … 7"),
        (Choice(only=(names[0].replace("Tr", "T"),)), f"did you mean '{names[0]}'"),
        (Choice(skip=("seed",)), "--skip seed: no such cell"),
    ):
        with pytest.raises(GridError) as caught:
            choice.of(cells)
        assert line in str(caught.value)


def test_an_array_jobs_task_runs_the_cell_of_its_number() -> None:
    assert task_number({}) is None
    assert task_number({"SLURM_ARRAY_TASK_ID": "11"}) == 11
    with pytest.raises(GridError, match="SLURM_ARRAY_TASK_ID is 'x'"):
        task_number({"SLURM_ARRAY_TASK_ID": "x"})
