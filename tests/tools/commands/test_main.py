"""Tests the command ``rsjax``: every command is listed, described, and has its module in experiments."""

import importlib
import sys
from configparser import ConfigParser
from importlib.metadata import EntryPoint
from pathlib import Path
from unittest.mock import patch

import pytest

from rsjax.tools.commands import main as command

ROOT = Path(__file__).parents[3]
NAMES = [name for group in command.COMMANDS.values() for name in group]


def call(*words: str) -> int:
    """Runs the command as its script does, and returns its exit status."""
    with patch.object(sys, "argv", ["rsjax", *words]):
        try:
            command.main()
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


def test_every_command_is_listed_and_is_a_module_of_experiments() -> None:
    others = {"__init__", "cli", "first_screens", "main"}
    files = {path.stem for path in Path(command.__file__).parent.glob("*.py")} - others
    assert sorted(NAMES) == sorted(files)
    assert {path.stem for path in (ROOT / "experiments").glob("*.py")} - {"__init__"} == files


def test_the_list_describes_each_command_by_a_sentence_and_an_example() -> None:
    lines = command.overview().splitlines()
    for name in NAMES:
        place = next(number for number, line in enumerate(lines) if line.split()[:1] == [name])
        assert lines[place].endswith((".", "Fig. 5).")), lines[place]
        assert lines[place + 1].startswith(f"{'':<21}rsjax {name}"), lines[place + 1]
    assert max(map(len, lines)) <= 120


def test_a_word_runs_the_command_of_that_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("policy-learning", "--help") == 0
    assert "usage: rsjax policy_learning" in capsys.readouterr().out
    assert call() == 0
    assert capsys.readouterr().out == command.overview() + "\n"
    assert call("--version") == 0
    assert capsys.readouterr().out.startswith("rsjax 0.")
    assert call("trian") == 2
    assert capsys.readouterr().err == "error: no command 'trian'; did you mean 'train'? (rsjax --help lists them)\n"


def test_the_script_of_an_installation_is_this_function() -> None:
    settings = ConfigParser()
    settings.read(ROOT / "setup.cfg")
    name, _, value = settings["options.entry_points"]["console_scripts"].strip().partition(" = ")
    assert name == "rsjax" and EntryPoint(name, value, "console_scripts").load() is command.main


def test_modules_of_experiments_call_the_commands() -> None:
    for name in ("train", "play", "convert"):
        ours = importlib.import_module(f"rsjax.tools.commands.{name}")
        assert importlib.import_module(f"experiments.{name}").main is ours.main
