"""Grids whose stages are toys: what is run, shared, skipped, recorded and resumed."""

import json
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from experiments import ablation
from rsjax.ablation import runner
from rsjax.ablation.grid import Cell, Choice
from rsjax.ablation.output import write_tables
from rsjax.ablation.results import lock_of, read_result, run_of
from rsjax.errors import Preempted, UserError
from rsjax.files import lock
from rsjax.pipeline.run import STAGES, Run
from tests.ablation import process, toy

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def stubs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy.stub_stages(monkeypatch, tmp_path)


def run(cells: tuple[Cell, ...], place: Path, choice: Choice | None = None) -> dict[str, str]:
    return dict(runner.run_grid(toy.DEBUG, cells, choice or Choice(), place / "out", place / "data"))


def states(cells: tuple[Cell, ...], place: Path) -> list[str]:
    return [read_result(cell, place / "out", place / "data").state for cell in cells]


def counts(place: Path) -> dict[str, int]:
    """How often each stage was made."""
    return Counter(line.split()[0] for line in toy.made(place))


def files(place: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in place.rglob("*") if path.is_file()}


def fail_in(monkeypatch: pytest.MonkeyPatch, name: str, error: BaseException) -> None:
    """The cell of this name fails after half of its stages."""
    whole = runner.run_all

    def failing(run: Run, command: str = "") -> None:
        if run.directory.name == name:
            with run.stage("world_model"):
                raise error
        whole(run, command=command)

    monkeypatch.setattr(runner, "run_all", failing)


def test_every_cell_is_a_whole_run_and_what_is_shared_is_made_once(tmp_path: Path) -> None:
    cells = toy.cells("loss.gamma=4,5", "tokenizer_train.entropy=0.1,0.2", seeds=(0, 1, 2))
    assert set(run(cells, tmp_path).values()) == {"finished"}
    assert counts(tmp_path) == {"collect": 1, "tokenizer": 2, "tokens": 2} | dict.fromkeys(STAGES[3:], len(cells))
    for cell in cells:
        there = run_of(cell, tmp_path / "out", tmp_path / "data")
        assert all(there.finished(stage) for stage in STAGES)
        for stage in ("tokenizer", "tokens"):
            assert (there.output(stage) / "weights").read_text() == there.keys()[stage]
            assert (there.output(stage) / "weights").stat().st_nlink >= 1 + 6
            assert (there.directory / stage / "log.jsonl").stat().st_nlink == 1, "logs are written on: never linked"
            assert not (there.directory / stage / "checkpoints").exists()
    assert not list(tmp_path.rglob("*.linking"))


def test_the_table_is_numpys_over_the_metrics_of_the_runs(tmp_path: Path) -> None:
    cells = toy.cells("loss.gamma=4,5", seeds=(0, 1, 2))
    run(cells, tmp_path)
    rows = json.loads((tmp_path / "out" / "table.json").read_text())["rows"]
    for row in rows:
        scores = [toy.psnr(cell.config) for cell in cells if cell.values == row["values"]]
        assert row["psnr"] == {"mean": np.mean(scores), "std": np.std(scores, ddof=1), "n": 3}
    assert {path.name for path in (tmp_path / "out").glob("table.*")} == {
        f"table.{e}" for e in ("md", "csv", "json", "png")
    }


def test_the_same_command_again_does_nothing(tmp_path: Path) -> None:
    cells = toy.cells("loss.gamma=4,5")
    run(cells, tmp_path)
    cell_files = {
        path: time for path, time in files(tmp_path).items() if "seed=0" in str(path) or "shared" in str(path)
    }
    assert set(run(cells, tmp_path).values()) == {"finished"}
    assert cell_files.items() <= files(tmp_path).items()


def test_a_cell_that_fails_is_recorded_and_the_others_run_then_it_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cells = toy.cells("loss.gamma=4,5,6")
    with monkeypatch.context() as patch:
        fail_in(patch, cells[1].name, ZeroDivisionError("by\nzero"))
        assert list(run(cells, tmp_path).values()) == ["finished", "failed", "finished"]
    assert states(cells, tmp_path) == ["finished", "failed", "finished"]
    told = json.loads((tmp_path / "out" / cells[1].name / "error.json").read_text())
    assert told["error"] == "ZeroDivisionError: by zero"
    assert "Traceback" in told["traceback"]
    table = (tmp_path / "out" / "table.md").read_text()
    assert f"- {cells[1].name}: failed (ZeroDivisionError: by zero)" in table
    assert list(run(cells, tmp_path).values()) == ["finished"] * 3
    assert not (tmp_path / "out" / cells[1].name / "error.json").exists()


@pytest.mark.parametrize("error", [KeyboardInterrupt(), Preempted("SIGTERM")])
def test_what_ends_the_command_is_not_the_cells_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    cells = toy.cells("loss.gamma=4,5,6")
    with monkeypatch.context() as patch:
        fail_in(patch, cells[1].name, error)
        with pytest.raises(type(error)):
            run(cells, tmp_path)
    assert states(cells, tmp_path) == ["finished", "interrupted", "missing"]
    assert read_result(cells[1], tmp_path / "out", tmp_path / "data").reason == "3 of 6 stages are finished"
    assert set(run(cells, tmp_path).values()) == {"finished"}


def test_cells_that_are_only_decoded_otherwise_share_the_world_model(tmp_path: Path) -> None:
    """Also with cells of an earlier command, whose own training it was."""
    run(toy.cells("loss.gamma=4,5"), tmp_path)
    assert counts(tmp_path)["world_model"] == 2
    run(toy.cells("loss.gamma=4,5", "sample.steps=2,3,4"), tmp_path)
    assert counts(tmp_path)["world_model"] == 2, "the earlier cells have it"
    run(toy.cells("loss.gamma=6", "sample.steps=2,3,4"), tmp_path)
    assert counts(tmp_path)["world_model"] == 3
    assert set(states(toy.cells("loss.gamma=4,5"), tmp_path)) == {"finished"}


def test_lost_numbers_are_counted_again_from_what_is_there(tmp_path: Path) -> None:
    cells = toy.cells("loss.gamma=4,5")
    run(cells, tmp_path)
    metrics = tmp_path / "out" / cells[0].name / "metrics.json"
    before = metrics.read_bytes()
    metrics.write_text("{")
    assert states(cells, tmp_path) == ["interrupted", "finished"]
    run(cells, tmp_path)
    assert metrics.read_bytes() == before


def test_a_cell_that_another_process_works_on_is_left_to_it(tmp_path: Path) -> None:
    cells = toy.cells("loss.gamma=4,5")
    with lock(lock_of(cells[0], tmp_path / "out")) as free:
        assert free
        assert list(run(cells, tmp_path).values()) == ["running", "finished"]
        assert states(cells, tmp_path) == ["running", "finished"]
    assert states(cells, tmp_path) == ["missing", "finished"]


def test_only_the_chosen_cells_run_and_the_table_names_all(tmp_path: Path) -> None:
    cells = toy.cells("loss.gamma=4,5", seeds=(0, 1))
    assert list(run(cells, tmp_path, Choice(number=2))) == [cells[2].name]
    assert states(cells, tmp_path) == ["missing", "missing", "finished", "missing"]
    rows = write_tables(tmp_path / "out", tmp_path / "data")
    assert [len(row.results) for row in rows] == [2, 2]
    with pytest.raises(UserError, match="--only x"):
        run(toy.cells("loss.gamma=9"), tmp_path, Choice(only=("x",)))
    assert "9.0" not in (tmp_path / "out" / "grid.json").read_text(), "a mistake leaves nothing behind"


def test_where_hard_links_do_not_go_there_are_copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr("rsjax.ablation.shared.os.link", refused)
    cells = toy.cells("loss.gamma=4,5")
    assert set(run(cells, tmp_path).values()) == {"finished"}
    there = run_of(cells[1], tmp_path / "out", tmp_path / "data")
    assert (there.output("tokens") / "weights").read_text() == there.keys()["tokens"]


def start(place: str, directory: Path) -> subprocess.Popen[str]:
    directory.mkdir(exist_ok=True)
    line = [sys.executable, "-m", process.__name__, place, *(directory / name for name in ("out", "data", "."))]
    return subprocess.Popen(list(map(str, line)), cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def test_two_processes_divide_the_cells_and_make_what_they_share_once(tmp_path: Path) -> None:
    both = [start("never", tmp_path) for _ in range(2)]
    outputs = [one.communicate()[0] for one in both]
    assert [one.returncode for one in both] == [0, 0], outputs
    cells = toy.cells(*process.AXES)
    assert counts(tmp_path) == {"collect": 1, "tokenizer": 2, "tokens": 2} | dict.fromkeys(STAGES[3:], len(cells))
    assert set(states(cells, tmp_path)) == {"finished"}
    assert all(f"{cells[0].name}" in output for output in outputs)
    assert "Not in the table" not in (tmp_path / "out" / "table.md").read_text()


def test_killed_and_run_again_it_ends_as_if_never_stopped(tmp_path: Path) -> None:
    """Killed while a shared stage is made, and while one is linked."""
    cells = toy.cells(*process.AXES)
    run(cells, tmp_path)
    whole = (tmp_path / "out" / "table.json").read_text()
    for place, killed in [(place, start(place, tmp_path / place)) for place in ("tokens", "link")]:
        output = killed.communicate()[0]
        assert killed.returncode == -signal.SIGKILL, output
        assert set(states(cells, tmp_path / place)) == {"interrupted", "missing"}
        assert set(run(cells, tmp_path / place).values()) == {"finished"}
        assert (tmp_path / place / "out" / "table.json").read_text() == whole
        assert not list((tmp_path / place).rglob("*.linking"))


def test_the_command_runs_lists_and_tells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit status 1 and the reason where a cell failed; ``--list`` and ``--table`` run nothing."""
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.hugetlb=0")  # no restart: it would be the tests'
    monkeypatch.delenv("SLURM_ARRAY_TASK_ID", raising=False)
    line = ["ablation", "debug", "--out", str(tmp_path / "out"), "--data-dir", str(tmp_path / "data")]

    def main(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", [*line, *arguments])
        try:
            ablation.main()
        except SystemExit as stop:
            return int(stop.code or 0)
        return 0

    axes = ("--grid", "loss.gamma=4,5", "--grid", "loss.keypoints=True", "--seeds", "0", "1")
    assert main("--table") == 2
    assert "holds no grid" in capsys.readouterr().err
    assert main(*axes, "--list") == 0
    assert capsys.readouterr().out.splitlines()[1].split() == [
        "1",
        "missing",
        "loss.gamma=5.0,loss.keypoints=True,seed=0",
    ]
    assert not (tmp_path / "out").exists()
    with monkeypatch.context() as patch:
        patch.setenv("SLURM_ARRAY_TASK_ID", "3")
        assert main(*axes) == 0
    assert main(*axes, "--list") == 0
    assert [row.split()[1] for row in capsys.readouterr().out.splitlines()[-4:]] == ["missing"] * 3 + ["finished"]
    with monkeypatch.context() as patch:
        fail_in(patch, "loss.gamma=4.0,loss.keypoints=True,seed=0", UserError("its cure"))
        assert main(*axes) == 1
    assert "seed=0: failed (its cure)" in capsys.readouterr().out
    assert main("--table") == 0
    assert "seed=0: failed (its cure)" in capsys.readouterr().out
    assert main(*axes, "--skip", "*gamma=4.0*", "--loss.depth", "2") == 2
    assert "another configuration (loss.depth is 1.0 there, 2.0 here)" in capsys.readouterr().err
    assert main(*axes) == 0
