"""The claims about policies: what their measurements ask for, and how scores per episode come from the answers."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rsjax.config import Config, presets
from rsjax.config.config_fields import with_values
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.ablation.grid import SEED
from rsjax.tools.studies.paper.claim import claims
from rsjax.tools.studies.paper.claims import policies
from rsjax.tools.studies.paper.claims.policies import Size
from rsjax.tools.studies.paper.measurements import measure, measured, read_scores, seconds_of
from tests.tools.policies.toy import demos

NAMES = ("policy-learning", "policy-evaluation", "policy-improvement", "planning")  # and policy-data


class Data:
    """A run on 40 demonstrations, without clips."""

    clips = config = simulator = None
    trained = SimpleNamespace(assets=SimpleNamespace(normalization=None))

    def demos(self) -> Any:
        return demos(40)

    def world(self, count: int) -> None: ...

    def first_frames(self, count: int) -> list[int]:
        return list(range(count))


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Experiments that answer at once, and what they were asked for."""
    asked: dict[str, Any] = {"judge": 0, "cells": []}

    def learn(settings: Any, config: Any, real: Any, synthetic: Any, world: Any, trials: Any, out: Path) -> Any:
        asked["cells"] += [(cell.name, out.parent.name.split("-")[0]) for cell in settings.chosen()]
        rows = [{"name": cell.name, "success": [[cell.real > 0, cell.synthetic > 10]]} for cell in settings.chosen()]
        return {"rows": rows}

    def compare(names: Any, simulator: Any, models: Any, trials: Any, out: Path) -> Any:
        asked["world"] = list(models)
        pair = {"simulator": [True, False], "world_model": [True, True]}
        return {"runs": [{"policies": dict.fromkeys(names, pair), "pearson": {"value": 0.7}}]}

    def improve(policy: Any, old: Any, starts: Any, *others: Any) -> Any:
        asked["starts"], asked["old"] = len(starts), len(old)
        last = {"imagined": [True, True], "control": [True, False]}
        return {"before": [False, False], "rounds": [{"imagined": [], "control": []}, last]}

    def plan(trained: Any, place: Path, simulator: Any, settings: Any) -> Any:
        asked["plan"] = settings
        ways = {"random": [False, False], "expert": [True, True], "cem": [False, True], "mppi": [True, True]}
        return {"episodes": [{"way": way, "success": hit} for way, row in ways.items() for hit in row]}

    monkeypatch.setattr(policies, "_judged", lambda run, size: Data())
    monkeypatch.setattr(policies, "open_lift", lambda *given: nullcontext())
    monkeypatch.setattr(policies, "action_range", lambda *given: None)
    monkeypatch.setattr(policies, "synthesize", lambda *given, **named: asked.update(demos=given[3].demos))
    monkeypatch.setattr(policies, "synthetic_demos", lambda *given: demos(40))
    monkeypatch.setattr(policies, "train_policy", lambda *given, **named: None)
    monkeypatch.setattr(policies.policy_evaluation, "checkpoints", lambda config, source, place: {"a": 1, "b": 2})
    monkeypatch.setattr(policies.policy_evaluation, "compare", compare)
    monkeypatch.setattr(policies.closed_loop, "compare", plan)
    monkeypatch.setattr(policies, "learn", learn)
    monkeypatch.setattr(policies, "improve", improve)
    return asked


def test_every_comparison_has_its_scores(tmp_path: Path, asked: dict[str, Any]) -> None:
    run, found = Run(_with_clips(20), tmp_path / "cell", tmp_path / "data"), {}
    for name in NAMES:
        for comparison in claims()[name].comparisons:
            measure(run, comparison.measurement)
            scores, reason = read_scores(run, comparison.measurement)
            assert not reason
            one, other = comparison.score, comparison.than_score
            found[name, one, other] = scores[one], scores[other]
    assert found["policy-learning", "many", "real"] == ([0, 1], [1, 0])
    assert found["policy-learning", "many", "few"] == ([0, 1], [0, 0])
    assert found["policy-learning", "few", "real_few"] == ([0, 0], [1, 0])
    assert found["policy-learning", "both", "repeated"] == ([1, 1], [1, 0])
    cells = ["synthetic-10", "synthetic-40", "real-40-synthetic-40", "real-10", "real-40", "real-40-repeated"]
    assert asked["cells"] == [(name, "policies") for name in cells]
    assert asked["demos"] == 40
    assert found["policy-evaluation", "same_outcome", "same_outcome"][0] == [1, 0, 1, 0] and asked["world"] == ["cell"]
    assert found["policy-evaluation", "pearson", "strong"] == ([0.7], [0.9])
    assert found["policy-improvement", "after", "before"] == ([1, 1], [0, 0])
    assert found["policy-improvement", "after", "control"] == ([1, 1], [1, 0])
    assert (asked["starts"], asked["old"]) == (2 * 40, 10)
    assert found["planning", "mppi", "random"] == ([1, 1], [0, 0])
    assert found["planning", "cem", "random"] == ([0, 1], [0, 0]) and asked["plan"].episodes == 10


def test_policies_learn_from_the_synthetic_video_of_every_family_with_actions(
    tmp_path: Path, asked: dict[str, Any]
) -> None:
    claim = claims()["policy-data"]
    assert [arm.name for arm in claim.arms] == ["RoboScape", "Genie", "iVideoGPT", "IRASim"]
    run = Run(_with_clips(20), tmp_path / "cell", tmp_path / "data")
    measure(run, "policies from synthetic video")
    scores, reason = read_scores(run, "policies from synthetic video")
    assert not reason
    assert {name for each in claim.comparisons for name in (each.score, each.than_score)} < scores.keys()
    assert scores == {"many": [0, 1], "both": [1, 1], "real": [1, 0]}
    cells = ["synthetic-40", "real-40-synthetic-40", "real-40"]
    assert asked["cells"] == [(name, "policies") for name in cells]
    names = ("roboscape_tiny", "irasim_tiny")
    ours, theirs = (seconds_of("policies from synthetic video", presets.get(name)) for name in names)
    whole = seconds_of("policies learned", presets.get("roboscape_tiny"))
    assert ours < theirs < whole


def test_policies_from_real_clips_are_shared_by_the_cells_on_them(tmp_path: Path) -> None:
    """And by no cell on other clips or of another size."""

    def place(config: Config, cell: str) -> Path:
        return policies._place(Run(config, tmp_path / cell, tmp_path), Size.of(config))

    whole = _with_clips(100)
    assert place(whole, "a") == place(with_values(whole, {SEED: 3, "model.width": 64}), "b")
    assert place(whole, "a") != place(_with_clips(50), "a")
    assert place(whole, "a") != place(with_values(whole, {"sim.seed": 9}), "a")


def test_sizes_and_estimates_shrink_with_the_cell() -> None:
    whole, half = (Size.of(_with_clips(clips)) for clips in (100, 50))
    assert whole.policy.train.steps == 2 * half.policy.train.steps == 2000
    assert (whole.trials.episodes, half.trials.episodes, whole.few, half.few) == (50, 25, 50, 25)
    for comparison in (each for name in NAMES for each in claims()[name].comparisons):
        seconds = [seconds_of(comparison.measurement, _with_clips(clips)) for clips in (50, 100)]
        assert seconds[0] == pytest.approx(seconds[1] / 2, rel=0.05)


def test_policies_are_judged_in_every_family_with_actions() -> None:
    """As in Fig. 5, which has iVideoGPT and IRASim; these generate a video for each frame, and take longer."""
    claim = claims()["policy-evaluation"]
    assert [arm.model or arm.preset for arm in claim.arms] == ["", "genie", "ivideogpt", "irasim"]
    compared = {(each.metric, each.than) for each in claim.comparisons}
    assert {(metric, arm.name) for arm in claim.arms[1:] for metric in ("correlation", "same_outcome")} < compared
    names = ("roboscape_tiny", "ivideogpt_tiny", "irasim_tiny")
    seconds = [seconds_of("policies judged", presets.get(name)) for name in names]
    assert seconds[0] < seconds[1] < seconds[2]


def test_cells_on_other_simulators_than_lift_train_no_judge_and_cost_nothing(tmp_path: Path) -> None:
    run = Run(presets.get("multitask"), tmp_path / "cell", tmp_path)
    for name in dict.fromkeys(each.measurement for claim in NAMES for each in claims()[claim].comparisons):
        measure(run, name)
        assert measured(run, name), "not to be tried again"
        scores, reason = read_scores(run, name)
        assert not scores and reason.startswith("policies are tried in the simulated Lift alone")
        assert seconds_of(name, run.config) == 0
    assert [path.name for path in run.directory.iterdir()] == ["measured"]


def _with_clips(clips: int) -> Config:
    return with_values(presets.roboscape_tiny(), {"eval.clips": clips})
