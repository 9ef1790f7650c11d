"""A claim of two arms, and cells that take no time and score what a test says."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rsjax.config import Config, RoboScapeConfig, presets
from rsjax.evaluation.results import Evaluation, save_evaluation
from rsjax.tools.pipeline import stages
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.paper import budget, claim_tables
from rsjax.tools.studies.paper.claim import Arm, ArmComparison, Claim, pairs
from rsjax.tools.studies.paper.plan import Plan, make_plan
from tests.tools.studies.ablation import toy

CLIPS = 12
Score = Callable[[Config], float]


def claim(name: str = "toy", *comparisons: ArmComparison, rank: int = 0) -> Claim:
    return Claim(
        name=name,
        title="Keypoints help",
        statement="Keypoints help.",
        place="Table 9",
        arms=(
            Arm("with", published={"psnr": 21.5}),
            Arm("without", {"model.loss.keypoints": "none"}, published={"psnr": 21.0}),
        ),
        comparisons=comparisons or pairs("with", "without", "psnr"),
        rank=rank,
    )


def plan(*claims: Claim, seconds: float = 10 * budget.HOUR) -> Plan:
    return make_plan(claims, budget.scale(presets.debug(), seconds), Path("data"))


def keypoints(config: Config) -> bool:
    assert isinstance(config.model, RoboScapeConfig)
    return config.model.loss.keypoints != "none"


def stub_stages(monkeypatch: pytest.MonkeyPatch, record: Path, gain: float = 0.5, noise: float = 0.01) -> None:
    """Stages leave toys; a cell with keypoints has ``gain`` dB more PSNR, and seeds differ by about ``noise``."""
    toy.stub_stages(monkeypatch, record)
    everything = stages.run_all

    def scored(run: Run, command: str = "") -> None:
        """Runs all stages and scores the cell."""
        everything(run, command=command)
        seed, on = run.config.train.seed, keypoints(run.config)
        clips = np.random.default_rng(0).normal(20, 3, CLIPS)
        draw = np.random.default_rng([seed, on]).normal(0, noise, CLIPS)
        psnr = clips + gain * on + draw + noise * np.random.default_rng([seed, on, 1]).normal()
        per_clip = {"psnr": psnr.tolist(), "physics_iq_spatial": [0.5] * CLIPS}
        means = {name: float(np.mean(numbers)) for name, numbers in per_clip.items()}
        result = Evaluation(means, {"ssim": "a toy"}, {}, per_clip)
        save_evaluation(run.output("evaluation"), result)
        (run.directory / "metrics.json").write_text(json.dumps(result.metrics | {"reasons": result.reasons}))

    monkeypatch.setattr(stages, "run_all", scored)
    monkeypatch.setattr(claim_tables, "draw", lambda rows, columns, title, source: b"")
