import importlib
from pathlib import Path
from typing import Any

import pytest

from experiments.cli import parse_options, part
from rsjax.config import ConfigError
from rsjax.errors import UserError
from rsjax.policies.improvement import Improvement
from rsjax.policies.learning import Learning
from rsjax.policies.synthesize import Synthesis
from rsjax.policies.trials import Trials


def parsed(command: str, *words: str) -> Any:
    module = importlib.import_module(f"experiments.{command}")
    return parse_options(words, command, module.Options.__doc__, module.Options())


def test_options_become_the_settings_of_each_part() -> None:
    learning = parsed("policy_learning", "runs/a", "--counts", "5", "10", "--episodes", "7", "--cells", "real-5")
    assert part(learning, Learning) == Learning((5, 10), cells=("real-5",))
    assert part(learning, Trials) == Trials(episodes=7) and learning.run == Path("runs/a")
    improve = parsed("improve", "runs/a", "--rounds", "3", "--max-steps", "9")
    assert part(improve, Improvement) == Improvement(rounds=3, max_steps=9) and part(improve, Trials).max_steps == 9
    made = parsed("synthesize", "runs/a", "--demos", "3", "--noise", "0.5", "--judge")
    assert part(made, Synthesis) == Synthesis(3, noise=0.5) and made.judge
    assert parsed("policy_evaluation", "runs/a", "runs/b").runs == (Path("runs/a"), Path("runs/b"))
    assert parsed("export", "store", "out", "--version", "v2.1").version == "v2.1"


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [
        ("policy_learning", ("--counts", "0"), "--counts"),
        ("policy_learning", ("--episodes", "0"), "--episodes is 0; it must be at least 1"),
        ("improve", ("--share", "1"), "--share is 1"),
        ("synthesize", ("--noise", "nan"), "--noise"),
        ("synthesize", ("--demo", "3"), "did you mean '--demos'"),
    ],
)
def test_impossible_options_are_named(command: str, words: tuple[str, ...], message: str) -> None:
    with pytest.raises((ConfigError, UserError), match=message):
        parsed(command, "runs/a", *words)
