"""Claims put to the test with toys: verdicts, failures, interruptions, measurements, the report."""

import json
import shutil
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import presets
from rsjax.config.config_fields import with_values
from rsjax.errors import Preempted
from rsjax.evaluation.registry import Unavailable
from rsjax.runtime import HUGE_PAGES
from rsjax.tools.commands import paper
from rsjax.tools.pipeline import stages
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.ablation.figure import draw
from rsjax.tools.studies.paper import claim_tables
from rsjax.tools.studies.paper import report as page
from rsjax.tools.studies.paper.budget import HOUR, Scale
from rsjax.tools.studies.paper.claim import ArmComparison, Claim
from rsjax.tools.studies.paper.claims import baselines
from rsjax.tools.studies.paper.judge import judge_all
from rsjax.tools.studies.paper.measurements import measure, measurement
from rsjax.tools.studies.paper.plan import Plan, make_plan
from rsjax.tools.studies.paper.result_files import read_claim_result
from rsjax.tools.studies.paper.run import run_plan, runs_of, write
from rsjax.tools.studies.tables import as_markdown
from tests.tools.pipeline.conftest import Commands, command, debug, shared
from tests.tools.studies.ablation.toy import made
from tests.tools.studies.paper import toy

__all__ = ["command", "debug", "shared"]


@measurement("policies", lambda config: 1.0)
def policies(run: Run) -> dict[str, list[float]]:
    """A score of each seed, and trials that often or never succeed."""
    often = [float(number < 90) for number in range(100)]
    correlation = {"r": [0.97 + 0.01 * run.config.train.seed], "strong": [0.9], "none": [float("nan")]}
    return correlation | {"often": often, "never": [0.0] * 100}


@measurement("fails once", lambda config: 1.0)
def fails_once(run: Run) -> dict[str, list[float]]:
    """Fails for the first run that it is called for; the file has the runs."""
    tries = run.directory.parents[2] / "tries"
    earlier = tries.exists()
    with tries.open("a") as file:
        file.write(f"{run.directory.name}\n")
    if not earlier:
        raise ValueError("once")
    return {"psnr": [1.0 + toy.keypoints(run.config), 2.0, 3.0]}


@measurement("other tasks", lambda config: 0.0)
def other_tasks(run: Run) -> dict[str, list[float]]:
    with (run.directory.parents[2] / "refusals").open("a") as file:
        file.write(f"{run.directory.name}\n")
    raise Unavailable("one task alone")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the cells of the toys' claims are finished; for copies."""
    place = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch:
        toy.stub_stages(patch, place)
        run(toy.plan(toy.claim("one"), toy.claim("two", rank=5)), place)
    return place


@pytest.fixture(autouse=True)
def stubs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy.stub_stages(monkeypatch, tmp_path)


@pytest.fixture
def cells(finished: Path, tmp_path: Path) -> None:
    """Finished cells in the test's directory."""
    shutil.copytree(finished, tmp_path, symlinks=True, dirs_exist_ok=True)


def run(plan: Plan, place: Path) -> Any:
    run_plan(plan, place / "out", place / "data", "the command")
    return report(place)


def report(place: Path) -> Any:
    return json.loads((place / "out" / "report.json").read_text())["claims"]


def judged(place: Path, *claims: Claim) -> Any:
    """Measures finished cells, and returns what the report says of claims about them."""
    plan = toy.plan(*claims)
    runs = runs_of(plan, place / "out", place / "data")
    for task in plan.tasks:
        if task.measurement:
            measure(runs[task.cell], task.measurement)
    write(plan, place / "out", place / "data", "the command")
    return report(place)


@pytest.mark.usefixtures("cells")
def test_a_claim_is_judged_by_paired_differences_and_what_was_not_measured_says_why(tmp_path: Path) -> None:
    """Clips differ by 3 dB, the arms by 0.5 dB: only paired differences can tell."""
    (claim,) = judged(
        tmp_path, toy.claim("toy", *(ArmComparison(name, "with", "without") for name in ("psnr", "ssim")))
    )
    compared, lacking = claim["comparisons"]
    assert claim["verdict"] == "holds", "of what could be measured"
    assert (compared["verdict"], compared["seeds"], compared["clips"]) == ("holds", [3, 3], toy.CLIPS)
    numbers = compared["values"]
    assert numbers["low"] < 0.5 < numbers["high"] and numbers["difference"] == pytest.approx(0.5, abs=0.05)
    assert numbers["published"] == 0.5
    means = [arm["values"]["psnr"]["mean"] for arm in claim["arms"]]
    assert means[0] - means[1] == pytest.approx(numbers["difference"], abs=0.005)  # clips have four digits
    assert (lacking["verdict"], lacking["reason"]) == ("not measured", "with: a toy")
    text = (tmp_path / "out" / "report.md").read_text()
    assert "not measured: with: a toy" in text
    assert "<small>with: a toy</small>" in (tmp_path / "out" / "report.html").read_text()
    read = read_claim_result(tmp_path / "out" / "results" / "toy.json")
    assert read.verdict == "holds" and [arm.seeds for arm in read.arms] == [(0, 1, 2)] * 2
    table = as_markdown(claim_tables.claim_tables(claim_tables.claim_content(read))["comparisons"])
    assert all(line in text for line in table.splitlines())


@pytest.mark.usefixtures("cells")
def test_cells_of_several_claims_run_once_and_a_second_command_runs_none(tmp_path: Path) -> None:
    plan = toy.plan(toy.claim("one"), toy.claim("two", rank=5))
    lines = made(tmp_path)
    assert sum(line.startswith("world_model") for line in lines) == len(plan.cells) == 6
    assert sum(line.startswith("tokenizer") for line in lines) == 1, "shared by all"
    first, second = ([claim["comparisons"] for claim in claims] for claims in (report(tmp_path), run(plan, tmp_path)))
    assert first == second and made(tmp_path) == lines


def test_failures_are_named_an_interruption_leaves_a_whole_report_and_the_next_command_does_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = toy.plan(toy.claim())
    names = list(plan.cells)
    errors = {names[3]: ZeroDivisionError("by zero"), names[5]: Preempted("SIGTERM")}
    whole = stages.run_all

    def fail(run: Run, command: str = "") -> None:
        if run.directory.name in errors:
            raise errors[run.directory.name]
        whole(run, command=command)

    with monkeypatch.context() as patch:
        patch.setattr(stages, "run_all", fail)
        with pytest.raises(Preempted):
            run(plan, tmp_path)
    (claim,) = report(tmp_path)
    assert [(arm["seeds"], arm["failed"]) for arm in claim["arms"]] == [("3 of 3", 0), ("1 of 3", 1)]
    failure = f"{names[3]}: failed (ZeroDivisionError: by zero)"
    assert failure in claim["missing"] and f"- {failure}" in (tmp_path / "out" / "report.md").read_text()
    assert claim["verdict"] == "cannot tell", "one seed of an arm says nothing about others"
    assert claim["comparisons"][0]["values"]["difference"] == pytest.approx(0.5, abs=0.05)
    before = len(made(tmp_path))
    (claim,) = run(plan, tmp_path)
    assert claim["verdict"] == "holds" and claim["missing"] == []
    assert len(made(tmp_path)) - before == 2 * 3, "evaluation, report and model of the two cells that were left"


@pytest.mark.usefixtures("cells")
def test_a_single_score_per_seed_is_judged_by_welchs_interval(tmp_path: Path) -> None:
    """Such as a correlation over policies, of which no clips can be drawn."""
    same: dict[str, Any] = {"better": "with", "than": "with", "measurement": "policies", "than_score": "strong"}
    (claim,) = judged(tmp_path, toy.claim("toy", *(ArmComparison("r", score=score, **same) for score in ("r", "none"))))
    one, other = claim["comparisons"]
    assert (one["verdict"], one["sides"], one["clips"]) == ("holds", "0.980 / 0.900", 1)
    assert one["values"]["sides"] == pytest.approx([0.98, 0.9])
    assert one["values"]["resampled_low"] is None and one["values"]["low"] > 0
    assert (other["verdict"], other["reason"]) == ("not measured", "no clip has a score in all seeds of both")


@pytest.mark.usefixtures("cells")
def test_policies_that_never_succeed_are_not_as_good_as_one_another(tmp_path: Path) -> None:
    claims = judged(
        tmp_path,
        *(
            toy.claim(name, ArmComparison("success", "with", "with", name, name, "policies", margin=-0.1))
            for name in ("often", "never")
        ),
    )
    assert [claim["verdict"] for claim in claims] == ["holds", "cannot tell"]
    for claim in claims:
        (found,) = claim["comparisons"]
        assert found["values"]["low"] < 0 < found["values"]["high"]
        assert claim["header"] == [], "the arms' own evaluations have no such score"
        assert not (tmp_path / "out" / "figures" / f"{claim['name']}.png").exists()


@pytest.mark.usefixtures("cells")
def test_a_measurement_runs_once_per_run_and_again_where_it_failed_unless_the_run_cannot_have_it(
    tmp_path: Path,
) -> None:
    names = ("fails once", "other tasks")
    plan = toy.plan(toy.claim("toy", *(ArmComparison("psnr", "with", "without", measurement=name) for name in names)))
    (claim,) = run(plan, tmp_path)
    assert [each["reason"] for each in claim["comparisons"]] == ["with: ValueError: once", "with: one task alone"]
    (claim,) = run(plan, tmp_path)
    assert claim["comparisons"][0]["values"]["difference"] == pytest.approx(1 / 3)
    assert claim["comparisons"][1]["reason"] == "with: one task alone"
    tries, refusals = ((tmp_path / name).read_text().split() for name in ("tries", "refusals"))
    assert sorted(tries) == sorted([*plan.cells, next(iter(plan.cells))])
    assert sorted(refusals) == sorted(plan.cells)


@pytest.mark.usefixtures("cells")
def test_budgets_share_a_directory(tmp_path: Path) -> None:
    """Cells of another size are others; each budget's report counts its own."""
    shorter = toy.plan(toy.claim(), seconds=240)
    assert shorter.cells.keys() == toy.plan(toy.claim()).cells.keys()
    assert shorter.left_out, "debug is the smallest already"
    (outcome,) = judge_all(shorter, runs_of(shorter, tmp_path / "out", tmp_path / "data"))
    assert [len(arm.finished) for arm in outcome.arms] == [3, 3], "also of cells that this budget would leave out"


def main(*argv: object) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GLIBC_TUNABLES", HUGE_PAGES)
        patch.setattr(sys, "argv", ["paper", *map(str, argv)])
        paper.main()


def test_a_run_of_the_preset_is_a_cell_and_its_scores_are_in_the_report(
    debug: Path,
    tmp_path: Path,
    command: Commands,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(claim_tables, "draw", draw)
    places = ("--dir", tmp_path, "--data-dir", command.data)
    options = ("--preset", "debug", "--budget", "3h", "--depth-estimator", "", *places)
    main(*options, "--only", "table2", "--dry-run")
    lines = capsys.readouterr().out.splitlines()
    assert not list(tmp_path.iterdir())
    name = lines[1].split()[3]
    assert lines[1].split()[2] == "missing" and name.startswith("seed=0-")
    (tmp_path / "cells").mkdir()
    (tmp_path / "cells" / name).symlink_to(debug)
    main(*options, "--report")
    claims = {claim["name"]: claim for claim in json.loads((tmp_path / "report.json").read_text())["claims"]}
    metrics = json.loads((debug / "metrics.json").read_text())
    for claim, arm in (("table2", "full"), ("data-scaling", "all")):
        (found,) = (each for each in claims[claim]["arms"] if each["name"] == arm)
        assert found["seeds"] == "1 of 3"
        assert found["values"]["psnr"]["mean"] == pytest.approx(metrics["psnr"], rel=1e-5)
    assert {claim["verdict"] for claim in claims.values()} == {"cannot tell"}
    assert (tmp_path / "report.html").exists() and (tmp_path / "figures" / "table2.png").exists()


def test_a_budget_may_spend_more_than_its_trainings_are_sized_for(
    command: Commands, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--seeds", 5, "--vary", "everything", "--data-dir", command.data, "--only", "depth-ways", "--dry-run")
    planned = []
    for budget in (("--budget", "3h"), ("--budget", "12h", "--size", "3h")):
        main(*options, *budget)
        lines = capsys.readouterr().out.splitlines()
        planned.append([line.split()[3] for line in lines if " missing " in line])
    short, long = planned
    assert long[: len(short)] == short
    assert len(long) == 20 > len(short)


@pytest.mark.usefixtures("cells")
def test_seconds_a_frame_stand_beside_each_arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the predicted frames of one clip, from its prompt."""
    rgb = np.zeros((6, 4, 4, 3), np.uint8)
    clip: dict[str, Any] = {"rgb": rgb, "depth": None, "actions": np.zeros((6, 2), np.float32)}
    asked: list[Any] = []

    def generate(*given: Any, index: Any) -> Video:
        asked.append(given)
        return Video(rgb[None])

    trained = SimpleNamespace(model=SimpleNamespace(generate=generate), params={}, assets=None)
    monkeypatch.setattr(baselines, "load", lambda directory: trained)
    monkeypatch.setattr(baselines, "median_seconds", lambda call, budget: (call(), 1.5)[1])
    monkeypatch.setattr(Run, "open_clips", lambda run: SimpleNamespace(source=lambda split: [clip]))
    claim = replace(toy.claim(), beside={"seconds a frame": "seconds a frame"})
    (found,) = judged(tmp_path, claim)
    assert found["beside"] == ["PSNR of the reconstruction", "seconds a frame"]
    assert [arm["beside"] for arm in found["arms"]] == [["–", "0.3"]] * 2
    assert asked[0][2].rgb.shape == (1, 1, 4, 4, 3) and asked[0][3].shape == (1, 6, 2)
    head = "| PSNR of the reconstruction | seconds a frame | trained parameters |"
    assert head in (tmp_path / "out" / "report.md").read_text()


@pytest.mark.parametrize("sound", [True, False])
def test_weights_of_metrics_that_come_later_train_nothing_again(tmp_path: Path, sound: bool) -> None:
    """But the marks of the runs that are there must have the same content keys."""
    first, later = (
        make_plan([toy.claim()], Scale(HOUR, with_values(presets.debug(), {"eval.weights": file})), Path("data"), [0])
        for file in ("", "elsewhere")
    )
    assert not first.cells.keys() & later.cells.keys()
    run(first, tmp_path)
    for there in runs_of(first, tmp_path / "out", tmp_path / "data").values():
        mark, key = there.directory / "world_model" / "made.json", there.keys()["world_model"]
        mark.write_text(mark.read_text().replace(key, key if sound else "0" * 16))
    run(later, tmp_path)
    counts = Counter(line.split()[0] for line in made(tmp_path))
    assert (counts["tokenizer"], counts["tokens"], counts["evaluation"]) == (1, 1, 4)
    assert counts["world_model"] == (2 if sound else 4)
    for there in runs_of(later, tmp_path / "out", tmp_path / "data").values():
        assert (there.output("world_model") / "weights").read_text() == there.keys()["world_model"]


@pytest.mark.usefixtures("cells")
def test_a_clip_is_shown_as_every_arm_predicts_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The one in the middle by the first arm's error among those that all arms kept, whatever else one of them kept."""
    kept = {"with": ([0, 2, 5], [40, 0, 20]), "without": ([0, 2, 4, 5], [1, 2, 9, 3])}

    def frames(folder: Path) -> dict[str, np.ndarray]:
        assert folder.name == "evaluation"  # where result.json and the frames are
        rows, shift = kept["without" if "keypoints=none" in str(folder) else "with"]
        truth = np.zeros((len(rows), 4, 8, 8, 3), np.uint8)
        shifted = truth + np.array(shift, np.uint8)[:, None, None, None, None]
        return {"rows": np.array(rows), "truth": truth, "prediction": shifted}

    drawn: list[Any] = []

    def sheet(clip: Any) -> np.ndarray:
        drawn.append(clip)
        return np.zeros((8, 8, 3), np.uint8)

    monkeypatch.setattr(page, "read_frames", frames)
    monkeypatch.setattr(page, "filmstrip", sheet)
    judged(tmp_path, toy.claim())
    shown = {name: int(video.max()) for name, video in drawn[-1].others}
    assert shown == {"with": 20, "without": 3}
    assert (tmp_path / "out" / "figures" / "toy-clip.webp").exists()
    assert "(figures/toy-clip.webp)" in (tmp_path / "out" / "report.md").read_text()
    drawn.clear()
    judged(tmp_path, toy.claim("toy", ArmComparison("psnr", "with", "without", measurement="policies")))
    assert not drawn  # the runs kept other frames than it compares


@pytest.mark.usefixtures("cells")
def test_a_figure_has_the_scores_that_the_claim_compares(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables of grids leave some of them out, such as Physics-IQ's; what was not measured has no panel."""
    drawn: list[str] = []

    def draw(rows: Any, columns: Any, title: str, source: str) -> bytes:
        drawn.extend(column.name for column in columns)
        return b""

    monkeypatch.setattr(claim_tables, "draw", draw)
    compared = (ArmComparison(metric, "with", "without") for metric in ("psnr", "physics_iq_spatial", "ssim"))
    judged(tmp_path, toy.claim("toy", *compared))
    assert set(drawn) == {"psnr", "physics_iq_spatial"}


def test_mistakes_are_one_line(command: Commands) -> None:
    assert "not a duration" in command.refused("experiments.paper", "--budget", "long")
    assert "unknown preset" in command.refused("experiments.paper", "--preset", "tinny")
    assert "no such claim" in command.refused("experiments.paper", "--only", "table3")
