"""Tests the parsing of commands: presets, overrides, options, and one clear line for what cannot run."""

import dataclasses
import errno
import os
import sys
from pathlib import Path
from typing import Any

import pytest
import tyro
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.config import Config, ConfigError, LossConfig, PublicCodeConfig, presets, to_dict
from rsjax.config.config_fields import with_values
from rsjax.errors import UserError, did_you_mean
from rsjax.files import write_json
from rsjax.tools.commands.cli import FIRST_FIELDS, main_errors, parse, parse_options


@dataclasses.dataclass(frozen=True)
class Options:
    run_dir: Path | None = None
    """where the run goes"""
    resume: bool = True


@dataclasses.dataclass(frozen=True)
class NeedsRun:
    run_dir: tyro.conf.Positional[Path] = tyro.MISSING
    clips: int = 4


def read(*argv: str) -> tuple[Config, Options]:
    return parse(argv, "python -m experiments.train", "Trains.", Options())


def message(*argv: str) -> str:
    with pytest.raises(UserError) as caught:
        read(*argv)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def numbers(part: Any, prefix: str = "--") -> list[tuple[str, str]]:
    """Returns (flag, value) for each number and truth value within ``part``."""
    flags: list[tuple[str, str]] = []
    for field in dataclasses.fields(part):
        value, flag = getattr(part, field.name), prefix + field.name
        if dataclasses.is_dataclass(value):
            flags += numbers(value, f"{flag}.")
        elif isinstance(value, (int, float)):
            flags.append((flag, str(value)))
    return flags


@pytest.mark.parametrize("name", sorted(presets.PRESETS))
def test_a_preset_alone_is_that_preset(name: str) -> None:
    assert read(name) == (presets.get(name), Options())


def test_a_run_directory_stands_for_its_configuration_where_that_is_allowed(tmp_path: Path) -> None:
    config = dataclasses.replace(presets.get("debug"), prompt_frames=2)
    write_json(tmp_path / "config.json", to_dict(config))
    assert parse([str(tmp_path)], "prog", "", Options(), runs=True)[0] == config
    with pytest.raises(ConfigError) as refused:
        parse([str(tmp_path)], "prog", "", Options())
    assert "unknown preset" in str(refused.value)


@settings(max_examples=10, deadline=None)
@given(st.lists(st.sampled_from(numbers(presets.get("debug"))), unique=True))
def test_flags_that_repeat_the_preset_change_nothing(flags: list[tuple[str, str]]) -> None:
    argv = [word for pair in flags for word in pair]
    assert read("debug", *argv) == (presets.get("debug"), Options())


def test_overrides_reach_their_field_and_no_other() -> None:
    config, options = read(
        "debug",
        *("--train.steps", "7", "--model.loss.keypoints", "none", "--sim.test-episodes=3", "--run-dir", "there"),
        *("--tokenizer.channel_multipliers", "2", "4", "--no-resume"),
    )
    base = presets.get("debug")
    assert config == dataclasses.replace(
        base,
        train=dataclasses.replace(base.train, steps=7),
        model=dataclasses.replace(base.model, loss=LossConfig(num_keypoints=8, keypoints="none")),  # type: ignore[call-arg]
        sim=dataclasses.replace(base.sim, test_episodes=3),
        tokenizer=dataclasses.replace(base.tokenizer, channel_multipliers=(2, 4)),
    )
    assert options == Options(run_dir=Path("there"), resume=False)


def test_a_family_is_chosen_before_its_fields_are_set() -> None:
    for flag in (["--model", "genie"], ["--model=genie"]):
        config, _ = read("debug", "--model.action-encoder", "none", *flag, "--model.sample.steps=3")
        genie = presets.get("debug").with_family("genie")
        assert config == with_values(genie, {"model.action_encoder": "none", "model.sample.steps": 3})


def test_a_section_is_chosen_by_a_word_and_switched_on_by_a_field_of_its_own() -> None:
    config, _ = read("debug", "--model.corruption", "off", "--model.public-code.qk-norm", "True")
    assert config == with_values(
        presets.get("debug"), {"model.corruption": None, "model.public_code": PublicCodeConfig(qk_norm=True)}
    )
    assert read("tiny", "--model.corruption=on") == read("tiny", "--model.corruption.probability", "0.5")


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (["tny"], "unknown preset 'tny'; did you mean 'tiny'? (presets: debug, "),
        ([], "name a preset first"),
        (["--train.steps", "3"], "name a preset first"),
        (["tiny", "--train.stps", "3"], "did you mean '--train.steps'?"),
        (["tiny", "--log-every", "3"], "did you mean '--runtime.log-every'?"),
        (["tiny", "--rundir", "x"], "did you mean '--run-dir'?"),
        (["tiny", "extra"], "unknown argument 'extra'"),
        (["tiny", "--train.steps", "many"], "--train.steps: invalid literal for int() with base 10: 'many'"),
        (["tiny", "--train.steps"], "Missing value for argument '--train.steps'"),
        (["tiny", "--store"], "Missing value for argument '--store'"),
        (["tiny", "--train.steps", "3", "--train.batch_size=4", "--train.steps=5"], "--train.steps is given twice"),
        (["tiny", "--model.max_frames", "16", "--model.max-frames", "16"], "--model.max-frames is given twice"),
        (["tiny", "--resume", "--no-resume"], "--resume is given twice; give it once, with all its values"),
        (["tiny", "--store", "a", "--store", "b"], "--store is given twice"),
        (
            ["tiny", "--model.sample.unmask", "worst"],
            "invalid choice 'worst' for argument '--model.sample.unmask'. Expected one of ('random', 'greedy')",
        ),
        (["tiny", "--sim.frames", "99", "--model.max-frames", "16"], "99 frames but model.max_frames is 16"),
        (["genie_35m", "--model.depth", "head"], "unknown argument '--model.depth'"),
        (["debug", "--model", "genie", "--model.loss.gamma", "2"], "unknown argument '--model.loss.gamma'"),
        (["tiny", "--model.corruption", "0.1"], "--model.corruption is '0.1'; choose on or off"),
        (["tiny", "--model.corruption"], "--model.corruption is ''; choose on or off"),
        (["tiny", "--model.corruption.rate", "1"], "unknown argument '--model.corruption.rate'"),
        (["debug", "--model", "geni"], "unknown model 'geni'; did you mean 'genie'? (models: cogvideox, genie, irasim"),
    ],
)
def test_each_mistake_gets_one_line_that_names_it(argv: list[str], expected: str) -> None:
    assert expected in message(*argv)


def test_options_without_a_preset() -> None:
    assert parse_options(["a/run", "--clips", "2"], "generate", "", NeedsRun(tyro.MISSING)) == NeedsRun(
        Path("a/run"), 2
    )
    with pytest.raises(ConfigError, match="did you mean '--clips'"):
        parse_options(["a/run", "--clip", "2"], "generate", "", NeedsRun(tyro.MISSING))
    with pytest.raises(ConfigError, match="missing RUN-DIR"):
        parse_options([], "generate", "", NeedsRun(tyro.MISSING))


def test_an_empty_path_is_refused() -> None:
    """As of a variable of the shell that is not set: Path("") would be the working directory."""
    assert parse_options(["."], "generate", "", NeedsRun(tyro.MISSING)).run_dir == Path()
    with pytest.raises(ConfigError) as raised:
        parse_options([""], "generate", "", NeedsRun(tyro.MISSING))
    assert "an empty path" in str(raised.value)


def test_only_options_that_add_up_may_be_repeated() -> None:
    @dataclasses.dataclass(frozen=True)
    class Adds:
        grid: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
        only: tuple[str, ...] = ()

    assert parse_options(["--grid", "a=1", "--grid", "b=2"], "ablation", "", Adds()) == Adds(("a=1", "b=2"))
    with pytest.raises(UserError, match="--only is given twice"):
        parse_options(["--only", "a", "--only", "b"], "ablation", "", Adds())


def shown(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    with pytest.raises(SystemExit) as caught:
        read(*argv)
    assert caught.value.code == 0
    text = capsys.readouterr().out
    assert "Trains." in text
    return text


def test_help_lists_presets_then_first_fields_then_all_fields(capsys: pytest.CaptureFixture[str]) -> None:
    for argv in (["--help"], ["--help-all"]):
        assert ", ".join(presets.PRESETS) in shown(capsys, *argv)
    first, everything = shown(capsys, "debug", "--help"), shown(capsys, "debug", "--help-all")
    assert [text.count("--run-dir") for text in (first, everything)] == [1, 1]
    assert [text.count("--model.loss.gamma") for text in (first, everything)] == [0, 1]
    assert "--store" in first
    assert "--help-all" in first
    for name in FIRST_FIELDS:
        assert f"--{name} " in first
        assert f"--{name} " in everything


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (ConfigError("sim.frames is 1;\n a clip needs 2"), 2, "error: sim.frames is 1; a clip needs 2"),
        (UserError("no OpenGL"), 2, "error: no OpenGL"),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "clips.tmp"), 2, "error: the disk is full at clips.tmp;"),
        (IsADirectoryError(errno.EISDIR, "Is a directory", "x"), 2, "error: Is a directory at x; choose another path"),
        (ValueError("RESOURCE_EXHAUSTED: write failed: No space left on device"), 2, "error: the disk is full; free"),
        (PermissionError(errno.EACCES, "Permission denied", "/root/x"), 2, "error: no permission to write or read at"),
        (KeyboardInterrupt(), 130, "interrupted; the same command resumes"),
    ],
)
def test_curable_errors_are_one_line_and_a_status(
    error: BaseException, status: int, line: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    @main_errors()
    def main() -> None:
        raise error

    monkeypatch.setattr("rsjax.command.exit_now", sys.exit)

    with pytest.raises(SystemExit) as caught:
        main()
    shown = capsys.readouterr().err
    assert caught.value.code == status
    assert shown.startswith(line)
    assert shown.count("\n") == 1


@pytest.mark.parametrize("bug", [ValueError("a bug"), FileNotFoundError("a bug")])
def test_bugs_keep_their_traceback(bug: Exception) -> None:
    with pytest.raises(type(bug), match="a bug"), main_errors():
        raise bug


def test_two_presets_of_one_name_are_refused() -> None:
    with pytest.raises(ConfigError, match="two presets are named 'debug'"):
        presets.collect(presets.debug(), presets.tiny(), presets.debug())


def test_nothing_near_suggests_nothing() -> None:
    assert did_you_mean("zzzz", ["train.steps", "tiny"]) == ""
