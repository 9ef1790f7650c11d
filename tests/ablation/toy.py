"""Grids of runs that are made in no time: their stages leave files and numbers, and train nothing."""

import json
from pathlib import Path

import pytest

from rsjax.ablation import runner
from rsjax.ablation.grid import Cell, expand, parse_axes
from rsjax.config import Config, presets
from rsjax.pipeline import stages
from rsjax.pipeline.run import STAGES, Run

DEBUG = presets.debug()


def cells(*axes: str, seeds: tuple[int, ...] = (0,), base: Config = DEBUG) -> tuple[Cell, ...]:
    return expand(base, parse_axes(base, axes), seeds)


def psnr(config: Config) -> float:
    """What a cell of this configuration scores."""
    return 20.0 + config.loss.gamma + config.train.seed / 8


def log(directory: Path, word: str) -> None:
    """Appends a word to the record of what was made."""
    with (directory / "made").open("a") as file:
        file.write(f"{word}\n")


def stub_stages(monkeypatch: pytest.MonkeyPatch, record: Path) -> None:
    """Puts the toys in place of the stages; what is made is told in ``record / "made"``."""

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
        for stage in STAGES:
            if not run.finished(stage):
                with run.stage(stage):
                    leave(run, stage)
                    if stage == "report":
                        (run.directory / "metrics.json").write_text(json.dumps({"psnr": psnr(run.config)}))

    monkeypatch.setattr(runner, "run_all", everything)
    monkeypatch.setattr(stages, "collect_clips", lambda run: None if run.clips.exists() else leave(run, "collect"))
    monkeypatch.setattr(stages, "train_tokenizer", lambda run, resume: leave(run, "tokenizer"))
    monkeypatch.setattr(stages, "tokenize", lambda run: leave(run, "tokens"))
    monkeypatch.setattr(stages, "train_world_model", lambda run, resume: leave(run, "world_model"))


def made(record: Path) -> list[str]:
    """What the toy stages made so far: stage and the directory's name, in order."""
    return (record / "made").read_text().splitlines() if (record / "made").exists() else []
