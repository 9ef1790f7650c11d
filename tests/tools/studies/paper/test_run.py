"""Claims put to the test with toys: verdicts, failures, interruptions, measurements, the report."""

import json
import sys
from collections import Counter
from collections.abc import Iterator
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
from rsjax.evaluation.statistics import Verdict
from rsjax.runtime import HUGE_PAGES
from rsjax.tools.commands import paper
from rsjax.tools.pipeline import stages
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.ablation import sweep
from rsjax.tools.studies.ablation.figure import draw
from rsjax.tools.studies.paper import claim_tables, measurements
from rsjax.tools.studies.paper import report as page
from rsjax.tools.studies.paper.budget import HOUR, Scale
from rsjax.tools.studies.paper.claim import ArmComparison
from rsjax.tools.studies.paper.claims import baselines
from rsjax.tools.studies.paper.judge import judge_all
from rsjax.tools.studies.paper.measurements import measurement
from rsjax.tools.studies.paper.plan import Plan, make_plan
from rsjax.tools.studies.paper.run import run_plan, runs_of, write
from tests.tools.pipeline.conftest import Commands, command, debug, shared
from tests.tools.studies.ablation.toy import made
from tests.tools.studies.paper import toy

__all__ = ["command", "debug", "shared"]


@pytest.fixture(autouse=True)
def stubs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy.stub_stages(monkeypatch, tmp_path)


def run(plan: Plan, place: Path) -> dict[str, Any]:
    run_plan(plan, place / "out", place / "data", "the command")
    return report(place)


def report(place: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((place / "out" / "report.json").read_text())
    return content


@pytest.mark.parametrize(("gain", "verdict"), [(0.5, "holds"), (-0.5, "does not hold"), (0.0, "equal")])
def test_a_claim_is_judged_by_paired_differences_over_seeds_and_clips(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gain: float, verdict: Verdict
) -> None:
    """Clips differ by 3 dB, the arms by 0.5 dB or not at all: only paired differences can tell."""
    toy.stub_stages(monkeypatch, tmp_path, gain)
    (claim,) = run(toy.plan(toy.claim()), tmp_path)["claims"]
    (compared,) = claim["comparisons"]
    assert claim["verdict"] == verdict
    assert compared["verdict"] == ("equal within 0.1 dB" if verdict == "equal" else verdict)
    assert (compared["seeds"], compared["clips"]) == ([3, 3], toy.CLIPS)
    numbers = compared["values"]
    assert numbers["low"] < gain < numbers["high"] and numbers["difference"] == pytest.approx(gain, abs=0.05)
    assert numbers["published"] == 0.5
    with_, without = claim["arms"]
    means = [arm["values"]["psnr"]["mean"] for arm in (with_, without)]
    assert means[0] - means[1] == pytest.approx(numbers["difference"], abs=0.005)  # clips have four digits


def test_cells_of_several_claims_run_once_and_a_second_command_runs_none(tmp_path: Path) -> None:
    plan = toy.plan(toy.claim("one"), toy.claim("two", rank=5))
    first = run(plan, tmp_path)["claims"]
    trained = [line for line in made(tmp_path) if line.startswith("world_model")]
    assert len(trained) == len(plan.cells) == 6
    assert sum(line.startswith("tokenizer") for line in made(tmp_path)) == 1, "shared by all"
    assert run(plan, tmp_path)["claims"] == first
    assert [line for line in made(tmp_path) if line.startswith("world_model")] == trained


def failing(monkeypatch: pytest.MonkeyPatch, name: str, error: BaseException) -> None:
    whole = stages.run_all

    def fail(run: Run, command: str = "") -> None:
        if run.directory.name == name:
            raise error
        whole(run, command=command)

    monkeypatch.setattr(stages, "run_all", fail)


def test_a_failed_cell_is_counted_and_named_and_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = toy.plan(toy.claim())
    name = list(plan.cells)[2]
    with monkeypatch.context() as patch:
        failing(patch, name, ZeroDivisionError("by zero"))
        (claim,) = run(plan, tmp_path)["claims"]
    arm = next(arm for arm in claim["arms"] if arm["failed"])
    assert (arm["seeds"], arm["failed"]) == ("2 of 3", 1)
    assert claim["missing"] == [f"{name}: failed (ZeroDivisionError: by zero)"]
    assert f"- {name}: failed (ZeroDivisionError: by zero)" in (tmp_path / "out" / "report.md").read_text()
    assert run(plan, tmp_path)["claims"][0]["missing"] == []


def test_an_interruption_leaves_a_whole_report_and_the_next_command_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = toy.plan(toy.claim())
    with monkeypatch.context() as patch:
        failing(patch, list(plan.cells)[3], Preempted("SIGTERM"))
        with pytest.raises(Preempted):
            run(plan, tmp_path)
    (claim,) = report(tmp_path)["claims"]
    assert [arm["seeds"] for arm in claim["arms"]] == ["2 of 3", "1 of 3"]
    assert claim["verdict"] == "cannot tell", "one seed of an arm says nothing about others"
    assert claim["comparisons"][0]["values"]["difference"] == pytest.approx(0.5, abs=0.05)
    before = len(made(tmp_path))
    assert run(plan, tmp_path)["claims"][0]["verdict"] == "holds"
    assert len(made(tmp_path)) - before == 3 * 3, "evaluation, report and model of the three cells that were left"


def test_what_was_not_measured_says_why(tmp_path: Path) -> None:
    claim = toy.claim("toy", ArmComparison("psnr", "with", "without"), ArmComparison("ssim", "with", "without"))
    (claim_,) = run(toy.plan(claim), tmp_path)["claims"]
    assert claim_["verdict"] == "holds", "of what could be measured"
    assert [each["verdict"] for each in claim_["comparisons"]] == ["holds", "not measured"]
    assert claim_["comparisons"][1]["reason"] == "with: a toy"
    assert "not measured: with: a toy" in (tmp_path / "out" / "report.md").read_text()
    assert "<small>with: a toy</small>" in (tmp_path / "out" / "report.html").read_text()


@pytest.fixture
def longer() -> Iterator[list[str]]:
    """A measurement that fails at its first run; the list has the runs that it was called for."""
    called: list[str] = []

    @measurement("longer", lambda config: 1.0)
    def longer(run: Run) -> dict[str, list[float]]:
        called.append(run.directory.name)
        if len(called) == 1:
            raise ValueError("once")
        return {"psnr": [1.0 + toy.keypoints(run.config), 2.0, 3.0]}

    yield called
    measurements._MEASUREMENTS.pop("longer")


def test_a_single_score_per_seed_is_judged_by_welchs_interval(tmp_path: Path) -> None:
    """Such as a correlation over policies, of which no clips can be drawn."""

    @measurement("correlation", lambda config: 1.0)
    def correlation(run: Run) -> dict[str, list[float]]:
        return {"r": [0.97 + 0.01 * run.config.train.seed], "strong": [0.9], "none": [float("nan")]}

    same: dict[str, Any] = {"better": "with", "than": "with", "measurement": "correlation"}
    holds = ArmComparison("r", score="r", than_score="strong", **same)
    undefined = ArmComparison("r", score="none", than_score="strong", **same)
    (claim,) = run(toy.plan(toy.claim("toy", holds, undefined)), tmp_path)["claims"]
    measurements._MEASUREMENTS.pop("correlation")
    one, other = claim["comparisons"]
    assert (one["verdict"], one["sides"], one["clips"]) == ("holds", "0.980 / 0.900", 1)
    assert one["values"]["sides"] == pytest.approx([0.98, 0.9])
    assert one["values"]["resampled_low"] is None and one["values"]["low"] > 0
    assert (other["verdict"], other["reason"]) == ("not measured", "no clip has a score in all seeds of both")


@pytest.mark.parametrize(("rate", "verdict"), [(0.0, "cannot tell"), (0.9, "holds")])
def test_policies_that_never_succeed_are_not_as_good_as_one_another(
    tmp_path: Path, rate: float, verdict: Verdict
) -> None:
    @measurement("trials", lambda config: 1.0)
    def trials(run: Run) -> dict[str, list[float]]:
        hits = [float(number < 100 * rate) for number in range(100)]
        return {"many": hits, "real": hits}

    compared = ArmComparison("success", "with", "with", "many", "real", "trials", margin=-0.1)
    (claim,) = run(toy.plan(toy.claim("toy", compared)), tmp_path)["claims"]
    measurements._MEASUREMENTS.pop("trials")
    (found,) = claim["comparisons"]
    assert found["verdict"] == verdict and found["values"]["low"] < 0 < found["values"]["high"]
    assert claim["header"] == [], "the arms' own evaluations have no such score"
    assert not (tmp_path / "out" / "figures" / "toy.png").exists()


def test_a_measurement_runs_once_per_run_and_again_where_it_failed(tmp_path: Path, longer: list[str]) -> None:
    plan = toy.plan(toy.claim("toy", ArmComparison("psnr", "with", "without", measurement="longer")))
    (claim,) = run(plan, tmp_path)["claims"]
    assert claim["comparisons"][0]["reason"] == "with: ValueError: once"
    (claim,) = run(plan, tmp_path)["claims"]
    assert claim["comparisons"][0]["values"]["difference"] == pytest.approx(1 / 3)
    assert sorted(longer) == sorted([*plan.cells, next(iter(plan.cells))])


def test_a_measurement_that_a_run_cannot_have_is_tried_once(tmp_path: Path) -> None:
    tried = []

    @measurement("other tasks", lambda config: 0.0)
    def other(run: Run) -> dict[str, list[float]]:
        tried.append(run.directory.name)
        raise Unavailable("one task alone")

    plan = toy.plan(toy.claim("toy", ArmComparison("psnr", "with", "without", measurement="other tasks")))
    for _ in range(2):
        (claim,) = run(plan, tmp_path)["claims"]
    measurements._MEASUREMENTS.pop("other tasks")
    assert claim["comparisons"][0]["reason"] == "with: one task alone"
    assert sorted(tried) == sorted(plan.cells)


def test_budgets_share_a_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells of another size are others; each budget's report counts its own."""
    plan = toy.plan(toy.claim())
    run(plan, tmp_path)
    shorter = toy.plan(toy.claim(), seconds=240)
    assert shorter.cells.keys() == plan.cells.keys() and shorter.left_out, "debug is the smallest already"
    write(shorter, tmp_path / "out", tmp_path / "data", "")
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
    def planned(*options: str) -> list[str]:
        main(
            "--seeds",
            "5",
            "--vary",
            "everything",
            "--data-dir",
            command.data,
            "--only",
            "depth-ways",
            "--dry-run",
            *options,
        )
        lines = capsys.readouterr().out.splitlines()
        return [line.split()[3] for line in lines if " missing " in line]

    short = planned("--budget", "3h")
    long = planned("--budget", "12h", "--size", "3h")
    assert long[: len(short)] == short
    assert len(long) == 20 > len(short)


def test_seconds_a_frame_stand_beside_each_arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the predicted frames of one clip, from its prompt."""
    clip: dict[str, Any] = {
        "rgb": np.zeros((6, 4, 4, 3), np.uint8),
        "depth": None,
        "actions": np.zeros((6, 2), np.float32),
    }
    asked: list[Any] = []

    def generate(*given: Any, index: Any) -> Video:
        asked.append(given)
        return Video(clip["rgb"][None])

    trained = SimpleNamespace(model=SimpleNamespace(generate=generate), params={}, assets=None)
    monkeypatch.setattr(baselines, "load", lambda directory: trained)
    monkeypatch.setattr(baselines, "median_seconds", lambda call, budget: (call(), 1.5)[1])
    monkeypatch.setattr(Run, "open_clips", lambda run: SimpleNamespace(source=lambda split: [clip]))
    claim = replace(toy.claim(), beside={"seconds a frame": "seconds a frame"})
    (found,) = run(toy.plan(claim), tmp_path)["claims"]
    assert found["beside"] == ["PSNR of the reconstruction", "seconds a frame"]
    assert [arm["beside"] for arm in found["arms"]] == [["–", "0.3"]] * 2
    assert asked[0][2].rgb.shape == (1, 1, 4, 4, 3) and asked[0][3].shape == (1, 6, 2)
    assert (
        "| PSNR of the reconstruction | seconds a frame | trained parameters |"
        in (tmp_path / "out" / "report.md").read_text()
    )


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


@pytest.mark.usefixtures("longer")
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
    run(toy.plan(toy.claim()), tmp_path)
    shown = {name: int(video.max()) for name, video in drawn[-1].others}
    assert shown == {"with": 20, "without": 3}
    assert (tmp_path / "out" / "figures" / "toy-clip.webp").exists()
    assert "(figures/toy-clip.webp)" in (tmp_path / "out" / "report.md").read_text()
    drawn.clear()
    run(toy.plan(toy.claim("toy", ArmComparison("psnr", "with", "without", measurement="longer"))), tmp_path)
    assert not drawn  # the runs kept other frames than it compares


def test_a_figure_has_the_scores_that_the_claim_compares(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables of grids leave some of them out, such as Physics-IQ's; what was not measured has no panel."""
    drawn: list[str] = []

    def draw(rows: Any, columns: Any, title: str, source: str) -> bytes:
        drawn.extend(column.name for column in columns)
        return b""

    monkeypatch.setattr(claim_tables, "draw", draw)
    compared = (ArmComparison(metric, "with", "without") for metric in ("psnr", "physics_iq_spatial", "ssim"))
    run(toy.plan(toy.claim("toy", *compared)), tmp_path)
    assert set(drawn) == {"psnr", "physics_iq_spatial"}


def test_mistakes_are_one_line(command: Commands) -> None:
    assert "not a duration" in command.refused("experiments.paper", "--budget", "long")
    assert "unknown preset" in command.refused("experiments.paper", "--preset", "tinny")
    assert "no such claim" in command.refused("experiments.paper", "--only", "table3")


def test_the_sweep_of_an_ablation_still_runs_cells_itself() -> None:
    assert sweep.run_cell.__module__ == sweep.run_sweep.__module__
