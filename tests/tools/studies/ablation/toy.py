"""Grids whose runs take no time: their stages leave files and numbers, and train nothing."""

import json
from pathlib import Path

import pytest

from rsjax.config import Config, RoboScapeConfig, presets
from rsjax.files import making
from rsjax.tools.pipeline import stages
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.ablation import sweep
from rsjax.tools.studies.ablation.grid import Grid, expand, parse_axes

DEBUG = presets.debug()


def grid(*axes: str, seeds: tuple[int, ...] = (0,), base: Config = DEBUG) -> Grid:
    return expand(base, parse_axes(base, axes), seeds)


def roboscape(config: Config) -> RoboScapeConfig:
    """The model's settings."""
    assert isinstance(config.model, RoboScapeConfig)
    return config.model


def psnr(config: Config) -> float:
    """The score of a cell with this configuration."""
    gamma = config.model.loss.gamma if isinstance(config.model, RoboScapeConfig) else 0.0
    return 20.0 + gamma + config.train.seed / 8


def log(directory: Path, word: str) -> None:
    """Appends a word to the list of stages that were made."""
    with (directory / "made").open("a") as file:
        file.write(f"{word}\n")


def made(directory: Path) -> list[str]:
    """Returns stage and run directory of every stage that was made, in order."""
    return (directory / "made").read_text().splitlines() if (directory / "made").exists() else []


def stub_stages(monkeypatch: pytest.MonkeyPatch, record: Path) -> None:
    """Puts the toys in place of the stages; ``record / "made"`` lists what they make. Pictures are left empty."""

    def leave(run: Run, stage: str) -> None:
        output = run.output(stage)
        if stage in ("tokenizer", "tokens", "world_model"):
            (output / "checkpoints").mkdir(parents=True, exist_ok=True)
            output, checkpoints = output / "weights", run.directory / stage / "checkpoints"
            checkpoints.mkdir(exist_ok=True)
            (checkpoints / "1").write_text("for resuming")
            (run.directory / stage / "log.jsonl").write_text('{"step": 1, "rgb": 3.0}\n{"step": 2, "rgb": 2.0}\n')
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(run.keys()[stage])
        log(record, f"{stage} {run.directory.name}")

    def everything(run: Run, command: str = "") -> None:
        for stage in run.stages:
            if not run.finished(stage):
                with run.stage(stage):
                    leave(run, stage)
                    if stage == "report":
                        (run.directory / "metrics.json").write_text(json.dumps({"psnr": psnr(run.config)}))

    def collect(run: Run) -> None:
        with making(run.clips, wait=True):
            if not run.clips.exists():
                leave(run, "collect")

    monkeypatch.setattr(stages, "run_all", everything)
    monkeypatch.setattr(stages, "collect_clips", collect)
    monkeypatch.setattr(stages, "train_tokenizer", lambda run, resume: leave(run, "tokenizer"))
    monkeypatch.setattr(stages, "prepare", lambda run: leave(run, "tokens"))
    monkeypatch.setattr(stages, "train_world_model", lambda run, resume: leave(run, "world_model"))
    monkeypatch.setattr(sweep, "draw", lambda rows, columns, title: b"")
