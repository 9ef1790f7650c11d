"""The main job through its command: whole, again, interrupted, changed, and with things broken."""

import json
import os
import re
import shutil
import signal
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.config import presets
from rsjax.models.load_run import load
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


def test_killed_and_run_again_it_gives_the_same_weights(debug: Path, tmp_path: Path, command: Commands) -> None:
    run = tmp_path / "run"
    # The tokens lie with the clips, where another test's run has made them.
    shutil.copytree(command.data, tmp_path / "data", ignore=shutil.ignore_patterns("tokens"))
    command = replace(command, data=tmp_path / "data")
    done = command("tests.tools.pipeline.killed", "tokens", "debug", "--run-dir", run)
    assert done.returncode == -signal.SIGKILL, done.stderr
    marks = {stage: run / stage / "made.json" for stage in STAGES}
    finished = [stage for stage, mark in marks.items() if mark.exists() and json.loads(mark.read_text())["finished"]]
    assert finished == list(STAGES[:2])
    assert not (run / "tokens" / "store").exists()
    assert skipped(command.train_here(run)) == finished
    assert_same_results(run, debug)


def test_a_run_directory_in_use_is_refused_by_name(tmp_path: Path, command: Commands) -> None:
    """Readers are not: they take no lock."""
    with Run(presets.debug(), tmp_path / "run", tmp_path).locked():
        line = command.refused("experiments.train", "debug", "--run-dir", tmp_path / "run", "--model.width", 64)
    assert f"{tmp_path / 'run'}: process {os.getpid()} on {socket.gethostname()} is training here; wait for it" in line
    assert [path.name for path in (tmp_path / "run").iterdir()] == [".lock"], "nothing is written"


def test_another_configuration_is_refused(debug: Path, command: Commands) -> None:
    before = files(debug)
    line = command.refused("experiments.train", "debug", "--run-dir", debug, "--model.loss.gamma", 4.0)
    assert "holds a world model of another configuration (model.loss.gamma is 5.0 there, 4.0 here)" in line
    assert "--overwrite" in line
    assert files(debug) == before


def test_parts_that_are_switched_off_are_gone_and_a_truncated_store_is_named_until_it_is_deleted(
    run: Path, debug: Path, command: Commands
) -> None:
    off = ("--model.depth", "none", "--model.loss.keypoints", "none")
    (shard,) = (run / "tokens" / "store").glob("train-*.array_record")
    os.truncate(shard, shard.stat().st_size // 2)
    line = command.refused("experiments.train", "debug", "--run-dir", run, *off, "--overwrite")
    assert str(shard) in line
    assert f"delete {shard.parent} and make it again" in line
    shutil.rmtree(shard.parent)
    assert skipped(command.train_here(run, *off)) == list(STAGES[:2])
    before, after = (read_log(place / "world_model")[-1].keys() for place in (debug, run))
    assert before - after == {"depth", "keypoint", "attention"}
    without = metrics(run)
    for name in ("depth_absrel", "depth_delta1"):
        assert metrics(debug)[name] is not None
        assert without[name] is None and without["reasons"][name]
    assert "test clip" in (run / "report.html").read_text()


def test_without_opengl_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.setattr(gl_module, "_loads", lambda library: False)
    line = Commands(tmp_path / "data").refused("experiments.train", "debug", "--run-dir", tmp_path / "run")
    assert line.startswith("error: no OpenGL library")
    assert "apt-get install" in line
    assert not (tmp_path / "data").exists()
    assert not json.loads((tmp_path / "run" / "collect" / "made.json").read_text())["finished"]


def test_a_run_that_left_no_step_out_says_so(debug: Path, command: Commands) -> None:
    assert "no step of world_model was skipped" in command.here("experiments.replay", debug)
    assert "step 3 was not skipped (skipped: none)" in command.refused("experiments.replay", debug, "--step", "3")
