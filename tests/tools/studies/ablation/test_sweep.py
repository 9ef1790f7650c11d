"""Sweeps whose stages are toys: what is run, shared, skipped, recorded and resumed."""

import json
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from rsjax.data.token_sets import OWN
from rsjax.errors import Preempted, UserError
from rsjax.files import lock
from rsjax.tools.commands import ablation
from rsjax.tools.pipeline import stages
from rsjax.tools.pipeline.run import STAGES, Run, link
from rsjax.tools.studies.ablation import sweep
from rsjax.tools.studies.ablation.grid import Choice, Grid
from rsjax.tools.studies.results import read_run
from tests.models.toy_family import ToyConfig
from tests.tools.studies.ablation import process, toy

ROOT = Path(__file__).parents[4]


@pytest.fixture(autouse=True)
def stubs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy.stub_stages(monkeypatch, tmp_path)


def sweep_in(place: Path, grid: Grid, choice: Choice | None = None) -> list[str]:
    """Runs a grid and returns the states of the chosen cells."""
    return list(sweep.run_sweep(grid, choice or Choice(), place / "out", place / "data").values())


def runs(place: Path, grid: Grid) -> list[Run]:
    return list(sweep.runs_of(grid, place / "out", place / "data").values())


def states(place: Path, grid: Grid) -> list[str]:
    return [read_run(run).state for run in runs(place, grid)]


def counts(place: Path) -> dict[str, int]:
    """How often each stage was made."""
    return Counter(line.split()[0] for line in toy.made(place))


def files(place: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in place.rglob("*") if path.is_file() and path.name != ".lock"}


def fail_in(monkeypatch: pytest.MonkeyPatch, name: str, error: BaseException) -> None:
    """The cell of this name fails after half of its stages."""
    whole = stages.run_all

    def failing(run: Run, command: str = "") -> None:
        if run.directory.name == name:
            with run.stage("world_model"):
                raise error
        whole(run, command=command)

    monkeypatch.setattr(stages, "run_all", failing)


def test_every_cell_is_a_whole_run_what_is_shared_is_made_once_and_the_table_is_numpys(tmp_path: Path) -> None:
    grid = toy.grid("model.loss.gamma=4,5", "tokenizer_train.entropy_weight=0.1,0.2", seeds=(0, 1))
    assert sweep_in(tmp_path, grid) == ["finished"] * 8
    assert counts(tmp_path) == {"collect": 1, "tokenizer": 2, "tokens": 2} | dict.fromkeys(STAGES[3:], 8)
    for there in runs(tmp_path, grid):
        assert all(there.finished(stage) for stage in STAGES)
        for stage in ("tokenizer", "tokens"):
            assert (there.output(stage) / "weights").read_text() == there.keys()[stage]
            assert (there.output(stage) / "weights").stat().st_nlink >= 1 + 4
            assert (there.directory / stage / "log.jsonl").stat().st_nlink == 1, "logs are written on: never linked"
            assert not (there.directory / stage / "checkpoints").exists()
    assert not list(tmp_path.rglob("*.linking"))
    for row in json.loads((tmp_path / "out" / "table.json").read_text())["rows"]:
        gamma = row["values"]["model.loss.gamma"]
        weight = row["values"]["tokenizer_train.entropy_weight"]
        cells = [c for c in grid.cells.values() if c.tokenizer_train.entropy_weight == weight]
        scores = [toy.psnr(config) for config in cells if toy.roboscape(config).loss.gamma == gamma]
        assert row["psnr"] == {"mean": np.mean(scores), "std": np.std(scores, ddof=1), "n": 2}
    names = {path.name for path in (tmp_path / "out").glob("table.*")}
    assert names == {f"table.{kind}" for kind in ("md", "csv", "json", "png")}


def test_the_same_command_again_does_nothing_but_count_lost_numbers_and_leave_out_damaged_logs(tmp_path: Path) -> None:
    grid = toy.grid("model.loss.gamma=4,5")
    sweep_in(tmp_path, grid)
    kept = {path: time for path, time in files(tmp_path).items() if "seed=0" in str(path) or "shared" in str(path)}
    assert sweep_in(tmp_path, grid) == ["finished", "finished"]
    assert kept.items() <= files(tmp_path).items()
    metrics = runs(tmp_path, grid)[0].directory / "metrics.json"
    before = metrics.read_bytes()
    metrics.write_text("{")
    assert states(tmp_path, grid) == ["interrupted", "finished"]
    sweep_in(tmp_path, grid)
    assert metrics.read_bytes() == before
    (metrics.parent / "world_model" / "log.jsonl").write_text('{"step"\n{"step": 2, "rgb": 2.0}\n')
    rows = sweep.write_tables(tmp_path / "out", tmp_path / "data")
    assert [row.results[0].state for row in rows] == ["interrupted", "finished"]


def test_a_cell_that_fails_is_recorded_and_the_others_run_then_it_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = toy.grid("model.loss.gamma=4,5,6")
    failing = list(grid.cells)[1]
    with monkeypatch.context() as patch:
        fail_in(patch, failing, ZeroDivisionError("by\nzero"))
        assert sweep_in(tmp_path, grid) == ["finished", "failed", "finished"]
    assert states(tmp_path, grid) == ["finished", "failed", "finished"]
    error = json.loads((tmp_path / "out" / failing / "error.json").read_text())
    assert error["error"] == "ZeroDivisionError: by zero"
    assert "Traceback" in error["traceback"]
    table = (tmp_path / "out" / "table.md").read_text()
    assert f"- {failing}: failed (ZeroDivisionError: by zero)" in table
    assert sweep_in(tmp_path, grid) == ["finished"] * 3
    assert not (tmp_path / "out" / failing / "error.json").exists()


def test_what_ends_the_command_is_not_the_cells_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = toy.grid("model.loss.gamma=4,5,6")
    with monkeypatch.context() as patch:
        fail_in(patch, list(grid.cells)[1], Preempted("SIGTERM"))
        with pytest.raises(Preempted):
            sweep_in(tmp_path, grid)
    assert states(tmp_path, grid) == ["finished", "interrupted", "missing"]
    assert read_run(runs(tmp_path, grid)[1]).reason == "3 of 6 stages are finished"
    assert sweep_in(tmp_path, grid) == ["finished"] * 3


def test_cells_that_are_only_decoded_otherwise_share_the_world_model(tmp_path: Path) -> None:
    """Also with cells of an earlier command, which trained it for themselves."""
    sweep_in(tmp_path, toy.grid("model.loss.gamma=4,5"))
    assert counts(tmp_path)["world_model"] == 2
    sweep_in(tmp_path, toy.grid("model.loss.gamma=4,5", "model.sample.steps=2,3,4"))
    assert counts(tmp_path)["world_model"] == 2, "the earlier cells have it"
    sweep_in(tmp_path, toy.grid("model.loss.gamma=6", "model.sample.steps=2,3,4"))
    assert counts(tmp_path)["world_model"] == 3
    assert states(tmp_path, toy.grid("model.loss.gamma=4,5")) == ["finished", "finished"]


def test_a_family_without_tokens_has_no_tokenizer_to_share(tmp_path: Path) -> None:
    grid = toy.grid(
        "model.start=0,1", "tokenizer_train.entropy_weight=0.1,0.2", base=toy.DEBUG.with_family(ToyConfig.family)
    )
    assert sweep_in(tmp_path, grid) == ["finished"] * 4
    assert counts(tmp_path) == {"collect": 1, "tokens": 1, "world_model": 2} | dict.fromkeys(STAGES[4:], 4)


def test_tokens_that_a_run_keeps_itself_are_linked_and_the_cell_reads_its_own(tmp_path: Path) -> None:
    maker, cell = (Run(toy.DEBUG, tmp_path / name, tmp_path / "data") for name in ("shared", "cell"))
    with maker.stage("tokens") as folder:
        (folder / OWN / "key").mkdir(parents=True)
        (folder / OWN / "key" / "tokens").write_text("many")
        (folder / OWN / ".key.lock").touch()
        link((folder / OWN / "key").absolute(), maker.output("tokens"))
    sweep.link_stage(maker, cell, "tokens")
    assert cell.output("tokens").resolve() == (cell.directory / "tokens" / OWN / "key").resolve()
    assert (cell.output("tokens") / "tokens").stat().st_nlink == 2
    assert [path.name for path in (cell.directory / "tokens" / OWN).iterdir()] == ["key"]


def test_a_cell_that_another_process_works_on_is_left_to_it(tmp_path: Path) -> None:
    grid = toy.grid("model.loss.gamma=4,5")
    with lock(runs(tmp_path, grid)[0].lock_file) as free:
        assert free
        assert sweep_in(tmp_path, grid) == ["running", "finished"]
        assert states(tmp_path, grid) == ["running", "finished"]
    assert states(tmp_path, grid) == ["missing", "finished"]
    with lock(runs(tmp_path, grid)[1].lock_file):  # as for another evaluation of it
        assert states(tmp_path, grid) == ["missing", "finished"]


def test_only_the_chosen_cells_run_and_the_table_names_all(tmp_path: Path) -> None:
    grid = toy.grid("model.loss.gamma=4,5", seeds=(0, 1))
    assert sweep_in(tmp_path, grid, Choice(number=2)) == ["finished"]
    assert states(tmp_path, grid) == ["missing", "missing", "finished", "missing"]
    rows = sweep.write_tables(tmp_path / "out", tmp_path / "data")
    assert [len(row.results) for row in rows] == [2, 2]
    with pytest.raises(UserError, match="--only x"):
        sweep_in(tmp_path, toy.grid("model.loss.gamma=9"), Choice(only=("x",)))
    assert "9.0" not in (tmp_path / "out" / "grid.json").read_text(), "a mistake leaves nothing behind"


def test_where_hard_links_do_not_go_there_are_copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr("rsjax.tools.studies.ablation.sweep.os.link", refused)
    grid = toy.grid("model.loss.gamma=4,5")
    assert sweep_in(tmp_path, grid) == ["finished", "finished"]
    there = runs(tmp_path, grid)[1]
    assert (there.output("tokens") / "weights").read_text() == there.keys()["tokens"]


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of the sweeps of :mod:`tests.tools.studies.ablation.process`, all ended."""
    base = tmp_path_factory.mktemp("processes")
    line = [sys.executable, "-m", process.__name__, str(base)]
    done = subprocess.run(line, cwd=ROOT, text=True, capture_output=True)
    assert done.returncode == 0, done.stderr
    killed = [-signal.SIGKILL]
    assert json.loads(done.stdout) == {"together": [0, 0], "tokens": killed, "link": killed}, done.stderr
    return base


def test_two_processes_divide_the_cells_and_make_what_they_share_once(processes: Path) -> None:
    place, grid = processes / "together", toy.grid(*process.AXES)
    assert counts(place) == {"collect": 1, "tokenizer": 2, "tokens": 2} | dict.fromkeys(STAGES[3:], len(grid.cells))
    assert set(states(place, grid)) == {"finished"}
    outputs = [(processes / f"output-{number}").read_text() for number in range(2)]
    assert all(next(iter(grid.cells)) in output for output in outputs)
    assert "Not in the table" not in (place / "out" / "table.md").read_text()


@pytest.mark.parametrize("place", ["tokens", "link"])
def test_killed_and_run_again_it_ends_as_if_never_stopped(processes: Path, place: str) -> None:
    """Killed while a shared stage is made, and while one is linked."""
    grid, killed = toy.grid(*process.AXES), processes / place
    assert set(states(killed, grid)) == {"interrupted", "missing"}
    assert set(sweep_in(killed, grid)) == {"finished"}
    assert (killed / "out" / "table.json").read_text() == (processes / "together" / "out" / "table.json").read_text()
    assert not list(killed.rglob("*.linking"))


def test_the_command_runs_lists_and_reports(
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

    axes = ("--grid", "model.loss.gamma=4,5", "--grid", "model.loss.keypoints=printed", "--seeds", "0", "1")
    assert main("--table") == 2
    assert "holds no grid" in capsys.readouterr().err
    assert main(*axes, "--list") == 0
    assert capsys.readouterr().out.splitlines()[1].split() == [
        "1",
        "missing",
        "model.loss.gamma=5.0,model.loss.keypoints=printed,seed=0",
    ]
    assert not (tmp_path / "out").exists()
    with monkeypatch.context() as patch:
        patch.setenv("SLURM_ARRAY_TASK_ID", "3")
        assert main(*axes) == 0
    assert main(*axes, "--list") == 0
    assert [row.split()[1] for row in capsys.readouterr().out.splitlines()[-4:]] == ["missing"] * 3 + ["finished"]
    with monkeypatch.context() as patch:
        fail_in(patch, "model.loss.gamma=4.0,model.loss.keypoints=printed,seed=0", UserError("its cure"))
        assert main(*axes) == 1
    assert "seed=0: failed (its cure)" in capsys.readouterr().out
    assert main("--table") == 0
    assert "seed=0: failed (its cure)" in capsys.readouterr().out
    assert main(*axes, "--skip", "*gamma=4.0*", "--model.loss.depth-weight", "2") == 2
    assert "another configuration (model.loss.depth_weight is 1.0 there, 2.0 here)" in capsys.readouterr().err
    assert main(*axes) == 0
