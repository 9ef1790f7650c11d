"""Weights & Biases, through interruptions and failures, with a module that records calls."""

import importlib
import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rsjax.training.log import ScalarLog, WandbError, find_wandb, read_log


class Run:
    def __init__(self, **options: Any) -> None:
        self.options, self.logged, self.metrics = options, list[dict[str, Any]](), list[tuple[str, str | None]]()
        self.exit_code: int | None = None
        self.url, self.dir, self.broken = None, "/somewhere", False

    def define_metric(self, name: str, step_metric: str | None = None) -> None:
        self.metrics.append((name, step_metric))

    def log(self, values: dict[str, Any]) -> None:
        if self.broken:
            raise ConnectionError("the service is gone\nat length")
        self.logged.append(values)

    def finish(self, exit_code: int) -> None:
        self.exit_code = exit_code


class Stub(SimpleNamespace):
    """The used part of ``wandb``."""

    def __init__(self) -> None:
        super().__init__(runs=[], Image=lambda image: ("image", image.shape), Settings=lambda **values: values)

    def init(self, **options: Any) -> Run:
        self.runs.append(Run(**options))
        return self.runs[-1]


@pytest.fixture
def wandb(monkeypatch: pytest.MonkeyPatch) -> Stub:
    stub = Stub()
    monkeypatch.setitem(sys.modules, "wandb", stub)  # type: ignore[arg-type]
    return stub


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    """A stage's directory in a run's."""
    directory = tmp_path / "arm" / "world_model"
    directory.mkdir(parents=True)
    (directory.parent / "config.json").write_text(json.dumps({"name": "tiny", "train": {"steps": 5}}))
    return directory


def test_it_gets_the_runs_configuration_scalars_and_images_if_there_is_a_project(wandb: Stub, stage: Path) -> None:
    with ScalarLog(stage, 0) as log:
        log.write(1, {"loss": 0.5})
    assert not wandb.runs and not (stage / "wandb.json").exists()
    with ScalarLog(stage, 0, wandb="robots") as log:
        log.write(1, {"loss": 0.5})
        log.image(1, "clip_000", np.zeros((4, 6, 3), np.uint8))
    (run,) = wandb.runs
    assert run.logged == [{"step": 1, "loss": 0.5}, {"step": 1, "clip_000": ("image", (4, 6, 3))}]
    assert run.options["project"] == "robots" and run.options["name"] == "arm/world_model"
    assert run.options["config"] == {"name": "tiny", "train": {"steps": 5}}
    assert run.metrics == [("step", None), ("*", "step")]
    assert run.exit_code == 0


def test_a_resumed_run_continues_the_same_one_but_another_project_or_a_fresh_start_does_not(
    wandb: Stub, stage: Path
) -> None:
    for start, project, resume in ((0, "robots", True), (4, "robots", True), (4, "arms", True), (0, "arms", False)):
        with ScalarLog(stage, start, wandb=project, resume=resume):
            pass
    first, resumed, other, anew = (run.options["id"] for run in wandb.runs)
    assert first == resumed
    assert len({first, other, anew}) == 3
    assert {run.options["resume"] for run in wandb.runs} == {"allow"}


def test_a_failed_training_is_shown_as_one(wandb: Stub, stage: Path) -> None:
    with pytest.raises(RuntimeError, match="boom"), ScalarLog(stage, 0, wandb="robots"):
        raise RuntimeError("boom")
    assert wandb.runs[0].exit_code == 1


def test_when_it_fails_training_continues_and_a_note_says_so_once(
    wandb: Stub, stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ScalarLog(stage, 0, wandb="robots") as log:
        wandb.runs[0].broken = True
        for step in (1, 2):
            log.write(step, {"loss": 0.5})
    assert [row["step"] for row in read_log(stage)] == [1, 2]
    printed = capsys.readouterr().out
    assert printed.count("Weights & Biases is off until the next start (the service is gone); training continues") == 1


def test_when_it_cannot_start_the_error_is_one_line_with_the_cure(wandb: Stub, stage: Path) -> None:
    def refuses(**_: Any) -> None:
        raise ValueError("api_key not configured (no-tty).\nSee the manual")

    wandb.init = refuses  # type: ignore[assignment, method-assign]
    with pytest.raises(WandbError, match=r"cannot start \(api_key not configured.*WANDB_MODE=offline") as raised:
        ScalarLog(stage, 0, wandb="robots")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("module", [None, SimpleNamespace()], ids=["nothing", "its own directory of files"])
def test_without_the_package_the_error_has_the_install_command(monkeypatch: pytest.MonkeyPatch, module: Any) -> None:
    monkeypatch.setitem(sys.modules, "wandb", module)
    with pytest.raises(WandbError, match=r"pip install 'rsjax\[wandb\]'"):
        find_wandb()


@pytest.mark.skipif(importlib.util.find_spec("wandb") is None, reason="needs the extra: pip install 'rsjax[wandb]'")
def test_the_real_one_keeps_runs_offline(stage: Path) -> None:
    lines = (
        "import sys, pathlib, numpy\n"
        "from rsjax.training.log import ScalarLog\n"
        "with ScalarLog(pathlib.Path(sys.argv[1]), 0, wandb='robots') as log:\n"
        "    log.write(1, {'loss': 0.5})\n"
        "    log.image(1, 'clip_000', numpy.zeros((4, 6, 3), numpy.uint8))\n"
    )
    environment = {"WANDB_MODE": "offline", "PATH": "/usr/bin:/bin", "PYTHONPATH": ":".join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, "-c", lines, str(stage)], env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    run_id = json.loads((stage / "wandb.json").read_text())["id"]
    assert list(stage.glob(f"wandb/offline-run-*/run-{run_id}.wandb"))
    assert list(stage.glob("wandb/offline-run-*/files/media/images/*.png"))
