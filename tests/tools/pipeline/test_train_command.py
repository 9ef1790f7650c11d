"""The main job through its command: whole, again, interrupted, changed, and with things broken."""

import json
import os
import re
import shutil
import signal
import socket
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.config import presets
from rsjax.models.load_run import load
from rsjax.tools.commands import train
from rsjax.tools.pipeline.run import STAGES, Run
from rsjax.tools.sim import gl as gl_module
from rsjax.training.log import read_log
from tests.tools.pipeline.conftest import Commands

WANTED = (
    "psnr psnr_repeat_first psnr_tokenizer ssim delta_psnr depth_absrel depth_absrel_repeat_first depth_delta1 "
    "depth_delta2 seconds_total"
)


def skipped(output: str) -> list[str]:
    return re.findall(r"^\[\d/6\] (\w+): up to date, skipped", output, re.MULTILINE)


def files(run: Path) -> dict[Path, tuple[int, int]]:
    """Every file's size and time of change, but for those that every start writes."""
    found = [
        path for path in run.rglob("*") if path.is_file() and path.name not in ("config.json", "run.json", ".lock")
    ]
    return {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in found}


def metrics(run: Path) -> dict[str, Any]:
    return json.loads((run / "metrics.json").read_text())


def assert_same_results(run: Path, other: Path) -> None:
    """The same weights, and the same scores but for the time."""
    trained = [load(place) for place in (run, other)]
    jax.tree.map(np.testing.assert_array_equal, *(model.params for model in trained))
    jax.tree.map(np.testing.assert_array_equal, *(model.assets.tokenizer for model in trained))
    one, two = metrics(run), metrics(other)
    assert one | {"seconds_total": 0} == two | {"seconds_total": 0}


def test_the_whole_job_leaves_a_report_and_metrics(debug: Path) -> None:
    output = (debug / "output").read_text()
    assert re.findall(r"^\[\d/6\] (\w+)", output, re.MULTILINE) == list(STAGES)
    assert not skipped(output)
    *_, report, after = output.rstrip().splitlines()
    assert report.startswith("report: ") and report.endswith("report.html")
    assert after.startswith("done in ") and "rsjax play" in after
    assert not re.search(r"robosuite|macro|UserWarning|DeprecationWarning|Traceback", output), output
    scores = metrics(debug)
    reasons = scores.pop("reasons")
    assert {"lpips_alex", "depth_absrel_median_estimator"} <= reasons.keys()
    assert [scores.pop(name) for name in reasons] == [None] * len(reasons)
    assert set(WANTED.split()) <= scores.keys()
    assert all(isinstance(value, float) and np.isfinite(value) for value in scores.values())
    seconds = [json.loads((debug / stage / "made.json").read_text())["seconds"] for stage in STAGES[:-1]]
    assert scores["seconds_total"] == pytest.approx(sum(seconds), abs=0.1)
    assert not list(debug.rglob("*.tmp")) + list(debug.rglob("*.building"))
    page = (debug / "report.html").read_text()
    assert "test clip" in page
    assert "–¹" in page and f"¹ {reasons['lpips_alex']}" in page
    assert "data:image/webp;base64," in page


def test_run_again_it_does_nothing(run: Path, command: Commands) -> None:
    before = files(run)
    assert skipped(command.train_here(run)) == list(STAGES)
    assert files(run) == before


def test_killed_twice_and_run_again_it_gives_the_same_weights(debug: Path, tmp_path: Path, command: Commands) -> None:
    run = tmp_path / "run"
    # The tokens lie with the clips, where another test's run has made them.
    shutil.copytree(command.data, tmp_path / "data", ignore=shutil.ignore_patterns("tokens"))
    command = replace(command, data=tmp_path / "data")
    for place, finished in (("tokens", STAGES[:2]), ("world_model", STAGES[:3])):
        done = command("tests.tools.pipeline.killed", place, "debug", "--run-dir", run)
        assert done.returncode == -signal.SIGKILL, done.stderr
        marks = {stage: run / stage / "made.json" for stage in STAGES}
        assert [s for s, mark in marks.items() if mark.exists() and json.loads(mark.read_text())["finished"]] == list(
            finished
        )
        assert not (run / place / {"tokens": "store", "world_model": "weights"}[place]).exists()
    assert skipped(command.train_here(run)) == list(STAGES[:3])
    assert [row["step"] for row in read_log(run / "world_model")] == [2, 4]
    assert_same_results(run, debug)


def test_another_evaluation_runs_only_what_depends_on_it(run: Path, command: Commands) -> None:
    assert skipped(command.train_here(run, "--eval.action-draws", 2)) == list(STAGES[:4])
    assert json.loads((run / "config.json").read_text())["eval"]["action_draws"] == 2


def test_a_run_directory_in_use_is_refused_by_name(tmp_path: Path, command: Commands) -> None:
    """Readers are not: they take no lock."""
    with Run(presets.debug(), tmp_path / "run", tmp_path).locked():
        line = command.refused("experiments.train", "debug", "--run-dir", tmp_path / "run", "--model.width", 64)
    assert f"{tmp_path / 'run'}: process {os.getpid()} on {socket.gethostname()} is training here; wait for it" in line
    assert [path.name for path in (tmp_path / "run").iterdir()] == [".lock"], "nothing is written"


@pytest.mark.parametrize(
    ("field", "value", "line"),
    [
        ("--tokenizer.res-blocks", 2, "holds a tokenizer of another configuration (tokenizer.res_blocks is 1 there, 2"),
        (
            "--model.loss.gamma",
            4.0,
            "holds a world model of another configuration (model.loss.gamma is 5.0 there, 4.0 here)",
        ),
    ],
)
def test_another_configuration_is_refused(debug: Path, command: Commands, field: str, value: float, line: str) -> None:
    before = files(debug)
    refusal = command.refused("experiments.train", "debug", "--run-dir", debug, field, value)
    assert line in refusal
    assert "--overwrite" in refusal
    assert files(debug) == before


def test_parts_that_are_switched_off_are_gone_and_the_rest_runs(run: Path, debug: Path, command: Commands) -> None:
    off = ("--model.depth", "none", "--model.loss.keypoints", "none")
    assert skipped(command.train_here(run, *off, "--overwrite")) == list(STAGES[:3])
    before, after = (read_log(place / "world_model")[-1].keys() for place in (debug, run))
    assert before - after == {"depth", "keypoint", "attention"}
    without = metrics(run)
    for name in ("depth_absrel", "depth_delta1"):
        assert metrics(debug)[name] is not None
        assert without[name] is None and without["reasons"][name]
    assert "test clip" in (run / "report.html").read_text()


def test_a_truncated_store_is_named_and_deleting_it_cures(run: Path, debug: Path, command: Commands) -> None:
    (shard,) = (run / "tokens" / "store").glob("train-*.array_record")
    os.truncate(shard, shard.stat().st_size // 2)
    shutil.rmtree(run / "world_model" / "weights")
    line = command.refused("experiments.train", "debug", "--run-dir", run)
    assert str(shard) in line
    assert f"delete {shard.parent} and make it again" in line
    shutil.rmtree(shard.parent)
    assert skipped(command.train_here(run)) == ["collect", "tokenizer", "evaluation", "report"]
    assert_same_results(run, debug)


def test_without_opengl_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.hugetlb=0")  # no restart: it would be the tests'
    monkeypatch.setattr(gl_module, "_loads", lambda library: False)
    places = ["--run-dir", str(tmp_path / "run"), "--data-dir", str(tmp_path / "data")]
    monkeypatch.setattr(sys, "argv", ["train", "debug", *places])
    with pytest.raises(SystemExit) as stop:
        train.main()
    assert stop.value.code == 2
    line = capsys.readouterr().err
    assert line.startswith("error: no OpenGL library")
    assert "apt-get install" in line
    assert line.count("\n") == 1
    assert not (tmp_path / "data").exists()
    assert not json.loads((tmp_path / "run" / "collect" / "made.json").read_text())["finished"]


def test_a_run_that_left_no_step_out_says_so(debug: Path, command: Commands) -> None:
    assert "no step of world_model was skipped" in command.here("experiments.replay", debug)
    assert "step 3 was not skipped (skipped: none)" in command.refused("experiments.replay", debug, "--step", "3")
