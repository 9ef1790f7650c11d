import json
from dataclasses import replace
from pathlib import Path

import pytest

from rsjax.ablation.fields import GridError
from rsjax.ablation.record import extend, keep_record, read_record
from tests.ablation import toy

WIDE = replace(toy.DEBUG, model=replace(toy.DEBUG.model, width=64))


def test_a_record_is_read_as_it_was_written(tmp_path: Path) -> None:
    assert read_record(tmp_path) is None
    cells = toy.cells("loss.gamma=4,5", "sample.unmask=greedy", seeds=(0, 7))
    kept, ours = keep_record(tmp_path, toy.DEBUG, cells)
    assert ours == cells
    assert read_record(tmp_path) == kept
    assert kept.cells == cells
    assert kept.fields == ("loss.gamma", "sample.unmask")
    assert json.loads((tmp_path / "grid.json").read_text())["versions"]["jax"]


def test_more_values_fields_and_seeds_add_cells_and_keep_those_there_are(tmp_path: Path) -> None:
    first = toy.cells("model.depth=True,False")
    keep_record(tmp_path, toy.DEBUG, first)
    _, ours = keep_record(tmp_path, toy.DEBUG, toy.cells("loss.gamma=4,5", seeds=(0, 1)))
    names = [cell.name for cell in ours]
    assert names[0] == "model.depth=True,loss.gamma=4.0,seed=0"
    assert names[1] == "model.depth=True,seed=0", "γ is 5 already: that cell is there"
    record = read_record(tmp_path)
    assert record is not None
    assert [cell.name for cell in record.cells] == [
        "model.depth=True,seed=0",
        "model.depth=False,seed=0",
        names[0],
        *names[2:],
    ]
    assert [cell.config for cell in record.cells[:2]] == [cell.config for cell in first]
    assert all(set(cell.values) == {"model.depth", "loss.gamma"} for cell in record.cells)
    assert len({cell.config for cell in record.cells}) == len(record.cells) == 5


def test_cells_of_several_bases_keep_their_values_and_names_apart(tmp_path: Path) -> None:
    """A field that was varied may differ in the configuration; each cell still has the value it was made with."""
    keep_record(tmp_path, toy.DEBUG, toy.cells("loss.gamma=4,5"))
    for gamma in (6.0, 7.0):
        base = replace(toy.DEBUG, loss=replace(toy.DEBUG.loss, gamma=gamma))
        keep_record(tmp_path, base, toy.cells("model.depth=True", base=base))
    record = read_record(tmp_path)
    assert record is not None
    assert [cell.config.loss.gamma for cell in record.cells] == [4.0, 5.0, 6.0, 7.0]
    assert len({cell.name for cell in record.cells}) == 4


def test_another_configuration_is_refused_by_name_and_nothing_changes(tmp_path: Path) -> None:
    keep_record(tmp_path, toy.DEBUG, toy.cells("loss.gamma=4,5"))
    before = (tmp_path / "grid.json").read_bytes()
    with pytest.raises(GridError) as caught:
        keep_record(tmp_path, WIDE, toy.cells("loss.gamma=4,5", base=WIDE))
    assert "another configuration (model.width is 32 there, 64 here); choose another --out" in str(caught.value)
    assert (tmp_path / "grid.json").read_bytes() == before


def test_how_runs_are_carried_out_and_the_seed_may_differ(tmp_path: Path) -> None:
    keep_record(tmp_path, toy.DEBUG, toy.cells("loss.gamma=4"))
    base = replace(toy.DEBUG, train=replace(toy.DEBUG.train, log_every=1, seed=9))
    record, _ = extend(read_record(tmp_path), base, toy.cells("loss.gamma=4", base=base), tmp_path)
    assert len(record.cells) == 1


@pytest.mark.parametrize("text", ["{", "{}", '{"config": {"name": "x", "nonsense": 1}}', "[]"])
def test_a_damaged_file_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "grid.json").write_text(text)
    with pytest.raises(GridError, match=r"grid.json: damaged or of another version .* --out"):
        read_record(tmp_path)
