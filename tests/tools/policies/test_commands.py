import importlib
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from rsjax.config import ConfigError
from rsjax.errors import UserError
from rsjax.files import write_file
from rsjax.tools.commands.cli import parse_options, part
from rsjax.tools.policies import policy_training as training_module
from rsjax.tools.policies.run_data import RunData
from rsjax.tools.policies.studies import policy_learning as learning_module
from rsjax.tools.policies.studies import trials as trials_module
from rsjax.tools.policies.studies.improvement import Improvement
from rsjax.tools.policies.studies.policy_learning import Learning
from rsjax.tools.policies.studies.synthesis import Synthesis
from rsjax.tools.policies.studies.trials import Trials
from tests.tools.policies.toy import demo_store, demos


def parsed(command: str, *words: str) -> Any:
    module = importlib.import_module(f"rsjax.tools.commands.{command}")
    return parse_options(words, command, module.Options.__doc__, module.Options())


def test_options_become_the_settings_of_each_part() -> None:
    learning = parsed("policy_learning", "runs/a", "--counts", "5", "10", "--episodes", "7", "--cells", "real-5")
    assert part(learning, Learning) == Learning((5, 10), cells=("real-5",))
    assert part(learning, Trials) == Trials(episodes=7) and learning.run == Path("runs/a")
    improve = parsed("improve", "runs/a", "--rounds", "3", "--max-steps", "9", "--follow-demos")
    assert part(improve, Improvement) == Improvement(rounds=3, max_steps=9, follow_demos=True)
    assert part(improve, Trials).max_steps == 9
    made = parsed("synthesize", "runs/a", "--demos", "3", "--noise", "0.5", "--judge")
    assert part(made, Synthesis) == Synthesis(3, noise=0.5) and made.judge
    assert parsed("policy_evaluation", "runs/a", "runs/b").runs == (Path("runs/a"), Path("runs/b"))
    assert parsed("export", "store", "out", "--version", "v2.1").version == "v2.1"


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [
        ("policy_learning", ("--counts", "0"), r"--counts \(0,\) and --seeds 1 must be 1 at least"),
        ("policy_learning", ("--episodes", "0"), "--episodes is 0; it must be at least 1"),
        ("improve", ("--share", "1"), "--share is 1"),
        ("adapt", ("--share", "1"), "--share is 1.0; it is a share"),
        ("adapt", ("--rounds", "3"), "--rounds is 3; it is 1 or 2"),
        ("synthesize", ("--noise", "nan"), "--noise nan: 1, 1 and 0 at least"),
        ("synthesize", ("--seed", "-1"), "--seed -1: 0 at least"),
        ("policy_learning", ("--seed", "-1"), "--seed is -1; it must be at least 0"),
        ("synthesize", ("--demo", "3"), "did you mean '--demos'"),
    ],
)
def test_impossible_options_are_named(command: str, words: tuple[str, ...], message: str) -> None:
    with pytest.raises((ConfigError, UserError), match=message):
        parsed(command, "runs/a", *words)


def called(command: str, monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    module = importlib.import_module(f"rsjax.tools.commands.{command}")
    monkeypatch.setattr(module, "tune_process", lambda: None)  # it would start the tests over
    monkeypatch.setattr(sys, "argv", [command, *map(str, words)])
    module.main()


def test_only_cells_of_synthetic_demonstrations_need_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(RunData, "demos", lambda self, seed: demos(2))
    monkeypatch.setattr(RunData, "simulator", None)
    monkeypatch.setattr(trials_module, "open_lift", lambda config, trials: nullcontext())

    def learn(settings: Learning, config: Any, real: Any, synthetic: Any, world: Any, trials: Any, out: Path) -> None:
        assert (len(real), len(synthetic)) == (2, 0)
        write_file(out / "results.md", b"learnt")

    monkeypatch.setattr(learning_module, "learn", learn)
    words = (tmp_path / "run", "--size", "toy", "--counts", 2, "--cells")
    called("policy_learning", monkeypatch, *words, "real-2", "real-2-repeated")
    assert "learnt" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        called("policy_learning", monkeypatch, *words, "real-2", "synthetic-2")
    assert "make synthetic demonstrations with" in capsys.readouterr().err


def test_improve_refuses_recordings_before_it_trains_a_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(RunData, "clips", demo_store(tmp_path / "store"))
    monkeypatch.setattr(RunData, "world", lambda self, count, judge: None)

    def train(*inputs: Any) -> None:
        raise AssertionError("a policy is trained")

    monkeypatch.setattr(training_module, "train_policy", train)
    with pytest.raises(SystemExit):
        called("improve", monkeypatch, tmp_path / "run", "--size", "toy", "--demos", 1)
    assert "clips of write_store; policies are tried in the simulated Lift" in capsys.readouterr().err
