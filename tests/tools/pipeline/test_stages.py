"""The tokenizer's stage around its training, which is left out."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.config import AdversarialConfig, LoopConfig, PerceptualConfig, TokenizerTrainConfig
from rsjax.config.config_fields import with_values
from rsjax.data.store import write_store
from rsjax.models.load_run import load_tokenizer
from rsjax.models.roboscape.model import RoboScape
from rsjax.tokenizers.training import TokenizerTraining
from rsjax.tools.pipeline import stages
from rsjax.tools.pipeline.run import Run
from rsjax.training.state import TrainState, create_state
from tests.models.toy_family import ToyConfig
from tests.tools.pipeline import toy

WHOLE = TokenizerTrainConfig(steps=2, perceptual=PerceptualConfig(), adversarial=AdversarialConfig())


def test_the_discriminator_stays_behind_and_the_missing_term_is_noted_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The run's tokenizer is the untrained one that the stage would begin with."""
    run = Run(replace(toy.config(), tokenizer_train=WHOLE), tmp_path / "run", tmp_path / "data")
    toy.store(run.clips)
    states = []

    def untrained(model: TokenizerTraining, loop: LoopConfig, *_: Any, **__: Any) -> TrainState:
        states.append(create_state(model, loop))
        return states[0]

    monkeypatch.setattr(stages, "fit", untrained)
    (run.directory / "tokenizer").mkdir(parents=True)
    stages.train_tokenizer(run, resume=True)
    (state,) = states
    assert "discriminator" in state.params
    jax.tree.map(np.testing.assert_array_equal, load_tokenizer(run.config, run.directory), state.params["generator"])
    assert capsys.readouterr().out.count("the LPIPS term is off: tokenizer_train.perceptual.lpips is empty") == 1


@pytest.mark.parametrize(("start", "reminded"), [(("", ""), 0), (("a", "a"), 0), (("a", ""), 1), (("a", "b"), 1)])
def test_weights_from_elsewhere_bring_the_reminder_of_their_tokens(
    start: tuple[str, str],
    reminded: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    cfg = toy.config()
    model_start, tokenizer_start = start
    cfg = replace(
        cfg,
        train=replace(cfg.train, start_from=model_start),
        tokenizer_train=replace(cfg.tokenizer_train, start_from=tokenizer_start),
    )
    run = Run(cfg, tmp_path / "run", tmp_path / "data")
    meta = {"key": "toy", "action_mean": [0.0], "action_std": [1.0], "depth_range": None}
    write_store(run.output("tokens"), "tokens", {"train": iter([{"rgb": np.zeros(3, np.int32)}])}, meta)
    monkeypatch.setattr(stages, "fit", lambda *_, **__: SimpleNamespace(weights={}))
    monkeypatch.setattr(stages, "save_weights", lambda *_: None)
    monkeypatch.setattr(RoboScape, "pretrained_shapes", lambda *_: {})
    stages.train_world_model(run, resume=True)
    assert capsys.readouterr().out.count("the tokens of this run's tokenizer") == reminded


def test_changed_code_is_noted_for_a_family_without_a_tokenizer_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run(replace(toy.config(), model=ToyConfig()), tmp_path / "run", tmp_path / "data")
    monkeypatch.setattr(stages, "record_start", lambda run, command: ["the code"])
    stages.note_changes(run, "")
    assert "since the last start the code changed" in capsys.readouterr().out


def test_a_start_says_how_to_get_lpips_where_its_weights_may_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for weights, said in (("weights", 1), ("", 0)):
        config = with_values(toy.config(), {"eval.weights": weights})
        stages.note_changes(Run(config, tmp_path / "run", tmp_path), "")
        assert capsys.readouterr().out.count("rsjax convert lpips --net alex gets them") == said
