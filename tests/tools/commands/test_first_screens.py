"""The first minute of every command: its help begins with an example, the output and the options that people use."""

import contextlib
import importlib
import sys
from unittest.mock import patch

import pytest

from rsjax.errors import UserError
from rsjax.evaluation.protocols import PROTOCOLS
from rsjax.tools.commands import ablation, evaluate, paper
from rsjax.tools.commands.cli import main_errors, parse, parse_options
from rsjax.tools.commands.first_screens import FIRST_SCREENS
from rsjax.tools.commands.hub import ACTIONS as HUB
from rsjax.tools.commands.main import COMMANDS
from rsjax.tools.commands.replay import Options
from rsjax.tools.commands.store import ACTIONS as STORE

NAMES = [name for group in COMMANDS.values() for name in group]
PARTS = [*(f"hub {word}" for word in HUB), *(f"store {word}" for word in STORE), "export libero"]
PRESETS = [f"{name} tiny" for name in ("train", "ablation", "describe", "compile", "bench")]
LINES = 36  # of a terminal, at a width of 100
# Commands that take minutes or hours. demo, play and serve run until they are stopped.
LONG = {"train", "finetune", "ingest", "evaluate", "ablation", "paper", "record", "adapt", "judge", "synthesize",
        "policy_learning", "policy_evaluation", "improve", "plan", "compile", "bench", "generate",
        "convert"}  # fmt: skip


def test_every_command_has_a_first_screen() -> None:
    assert sorted(FIRST_SCREENS) == sorted([*NAMES, *PARTS])
    for name in LONG:
        assert FIRST_SCREENS[name].following, f"{name} takes long, and does not say what to do next"


@pytest.mark.parametrize("line", [*NAMES, *PARTS, *PRESETS])
def test_help_begins_with_example_output_and_used_options(
    line: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    name, *words = line.split()
    module = importlib.import_module(f"rsjax.tools.commands.{name}")
    with patch.object(sys, "argv", [f"rsjax {name}", *words, "--help"]), contextlib.suppress(SystemExit):
        module.main()
    first = "\n".join(capsys.readouterr().out.splitlines()[:LINES])
    screen = FIRST_SCREENS.get(line) or FIRST_SCREENS[name]
    assert first.startswith("usage: rsjax ")
    assert f"Example:  {screen.example}" in first and screen.example.startswith(f"rsjax {name}")
    assert f"Output:   {screen.output}" in first
    assert len(screen.used) <= 5
    for option in screen.used:
        assert f"--{option} " in first or f"--{option}," in first or f"--{option}\n" in first, option


def test_the_help_of_evaluate_lists_all_protocols(capsys: pytest.CaptureFixture[str]) -> None:
    with patch.object(sys, "argv", ["rsjax evaluate", "--help"]), contextlib.suppress(SystemExit):
        evaluate.main()
    listed = " ".join(capsys.readouterr().out.split())
    assert f"{', '.join(PROTOCOLS)}, or run" in listed


def test_the_end_says_how_long_it_took_and_what_is_next(capsys: pytest.CaptureFixture[str]) -> None:
    @main_errors()
    def judge() -> None:
        parse_options(["runs/mine"], "rsjax judge", "", Options())
        print("the result")

    judge()
    out, err = capsys.readouterr()
    assert out == "the result\n"
    assert err.startswith("done in 0 s; next: ") and "rsjax improve runs/mine" in err and err.count("\n") == 1


def test_after_a_look_the_next_step_is_the_command_itself(capsys: pytest.CaptureFixture[str]) -> None:
    @main_errors()
    def dry() -> None:
        parse_options(["--dry-run"], "rsjax paper", "", paper.Options())

    @main_errors()
    def listed() -> None:
        parse(["tiny", "--list"], "rsjax ablation", "", ablation.Options())

    for command, option in ((dry, "--dry-run"), (listed, "--list")):
        command()
        assert capsys.readouterr().err.endswith(f"; next: the same command without {option} does it\n")


def test_a_command_that_fails_or_was_not_called_so_says_nothing_of_what_is_next(
    capsys: pytest.CaptureFixture[str],
) -> None:
    @main_errors()
    def fails() -> None:
        parse_options(["runs/mine"], "rsjax judge", "", Options())
        raise UserError("no clips")

    @main_errors()
    def other() -> None:
        print("the result")

    with pytest.raises(SystemExit):
        fails()
    other()
    assert capsys.readouterr().err == "error: no clips\n"
