"""Parses the arguments of every command."""

import contextlib
import dataclasses
import io
import os
import re
import sys
import time
from collections.abc import Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar, get_args, get_type_hints

import tyro

from rsjax import command
from rsjax.config import Config, ConfigError, CurriculumStageConfig, check_numbers, presets, require
from rsjax.config.config_fields import config_fields, with_sections, with_values
from rsjax.config.curriculum import read_curriculum, write_curriculum
from rsjax.errors import did_you_mean
from rsjax.files import check_place
from rsjax.tools.commands.first_screens import FIRST_SCREENS, FirstScreen

Options = TypeVar("Options")

# The fields that ``PRESET --help`` lists; ``--help-all`` lists all fields. A field that the preset lacks is skipped.
FIRST_FIELDS = {
    "sim.episodes": "Simulated episodes, those of the test split included.",
    "sim.test-episodes": "Episodes of the test split.",
    "sim.seed": "Seed of the simulated episodes.",
    "sim.recipe": "What training episodes show, with shares: expert=0.6 grasps=0.4 (docs/simulators.md).",
    "sim.env": "The simulator: lift, metaworld, rope or tabletop (docs/simulators.md).",
    "sim.tasks": "Tasks of Meta-World to train on, such as reach drawer-open.",
    "tokenizer-train.steps": "Training steps of the tokenizer.",
    "tokenizer-train.batch-size": "Clips of a batch, over all devices.",
    "tokenizer-train.optimizer.learning-rate": "Peak learning rate of the tokenizer.",
    "model.width": "Channels of the world model.",
    "model.blocks": "Transformer blocks of the world model.",
    "model.action-encoder": "How the model reads actions.",
    "train.steps": "Training steps of the world model.",
    "train.curriculum": "A curriculum: a file with a JSON list of stages, or the list (docs/training.md); []: none.",
    "train.batch-size": "Clips of a batch, over all devices.",
    "train.optimizer.learning-rate": "Peak learning rate of the world model.",
    "train.seed": "Seed of the world model's training, 0 to 4294967295.",
    "train.start-from": "A run directory or converted checkpoint to start from.",
    "runtime.checkpoint-every": "Steps between checkpoints.",
    "runtime.eval-every": "Steps between evaluations on validation clips; 0: none.",
    "runtime.wandb": "Log to this Weights & Biases project as well; WANDB_MODE=offline keeps it on disk.",
    "model.loss.depth-weight": "λ₁, the weight of the depth loss.",
    "model.loss.keypoint-weight": "λ₂, the weight of the keypoint loss.",
    "model.loss.attention-weight": "λ₃, the weight of the attention loss.",
    "model.loss.keypoints": "The keypoint loss: none, printed (Eq. 5), difference, motion or feature.",
    "model.sample.steps": "Decoding steps per generated frame.",
    "eval.clips": "Test clips to evaluate on.",
    "eval.weights": "A directory with the weights of LPIPS and FVD (see docs/evaluation.md).",
    "eval.depth-estimator": "What estimates depth from frames: simulator, or a network (see docs/evaluation.md).",
}

# Options that name what a command writes, checked before it works.
PLACES = {
    **dict.fromkeys(("out", "run_dir", "dir", "into", "blind"), "directory"),
    **dict.fromkeys(("json", "dump", "fix", "sheet", "rerun_file"), "file"),
}

# Options with which a command only shows what it would do.
SHOWING = ("dry_run", "list")

REGISTRY = tyro.constructors.ConstructorRegistry()


@REGISTRY.primitive_rule
def _path(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec | None:
    """Reads a path; an empty word, as of a variable that is not set, would mean the working directory."""
    if info.type not in (Path, Path | None):
        return None

    def read(words: list[str]) -> Path | None:
        if words[0] == "None" and info.type is not Path:
            return None
        if not words[0]:
            raise ValueError("an empty path; name one, or . for the working directory")
        return Path(words[0])

    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, Path) or (value is None and info.type is not Path),
        str_from_instance=lambda path: [str(path)],
    )


@REGISTRY.primitive_rule
def _curriculum(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec | None:
    """Reads a curriculum from one word: a JSON list of stages, or the path of a file with one."""
    if get_args(info.type) != (CurriculumStageConfig, ...):
        return None
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="FILE.json",
        instance_from_str=lambda words: read_curriculum(words[0]),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda stages: [write_curriculum(stages)],
    )


@dataclasses.dataclass(frozen=True)
class PresetOptions:
    """Options of every command that takes a preset. They change the preset before its fields are set."""

    model: str | None = None
    """The model's family (roboscape, genie, ivideogpt, irasim, cogvideox); settings that both families have stay."""
    store: Path | None = None
    """A store of clips made by rsjax ingest, to train on instead of simulated clips."""

    def apply(self, preset: Config) -> Config:
        """Returns the preset changed by these options."""
        if self.model is not None:
            preset = preset.with_family(self.model)
        if self.store is not None:
            from rsjax.tools.pipeline.run_clips import on_store

            preset = on_store(preset, self.store)
        return preset


def parse(
    argv: Sequence[str], prog: str, description: str, options: Options, runs: bool = False
) -> tuple[Config, Options]:
    """Parses ``PRESET [--option VALUE] [--section.field VALUE]``.

    Args:
        argv: the arguments, without the program's name.
        prog: the command as the user types it, ``rsjax train``.
        description: what the command does, for ``--help``.
        options: a dataclass of the command's own options, with their defaults.
        runs: whether a run directory may stand in the place of a preset, for its configuration.

    Returns:
        The preset with its overrides, checked, and the options.

    Raises:
        ConfigError: an unknown preset or field, a value that does not parse, or an impossible combination.
        SystemExit: with status 0, after printing the requested help.
    """
    fields: Any
    usage = f"usage: {prog} PRESET [--section.field VALUE]; presets: {', '.join(presets.PRESETS)}"
    if not argv or argv[0].startswith("-"):
        if not {"-h", "--help", "--help-all"}.intersection(argv):
            raise ConfigError(f"name a preset first; {usage}")
        more = f"Options and common fields: {prog} tiny --help; every field: --help-all"
        fields = _first_fields(presets.get("tiny"))
        listed = _help({"options": options, "preset": PresetOptions(), "fields": fields}, prog, "")
        print(usage, with_first_screen(f"\n{description}", prog, listed), more, sep="\n")
        raise SystemExit(0)
    name, *argv = argv
    command.refuse_repeated(argv, _adding(options))
    prog = f"{prog} {name}"
    if runs and (Path(name) / "config.json").exists():
        from rsjax.models.load_run import load_config

        preset = load_config(Path(name))
    else:
        preset = presets.get(name)
    preset_options = _parse({"preset": PresetOptions()}, argv, prog, "", rest=True).preset
    preset = preset_options.apply(preset)
    chosen, argv = choose_sections(preset, argv)
    fields = chosen
    if {"-h", "--help"}.intersection(argv):
        parts = {"options": options, "preset": preset_options, "fields": _first_fields(chosen)}
        _show_help(parts, prog, f"{description} Every field: {prog} --help-all")
    elif "--help-all" in argv:
        sections = [
            f"--{_flag(name)} {'|'.join(get_args(field.kind))}, now {field.value}"
            for name, field in config_fields(chosen).items()
            if field.section
        ]
        description = f"{description} Sections: {'; '.join(sections)}."
        argv = ["--help"]
    parsed = _parse({"options": options, "preset": preset_options, "fields": fields}, argv, prog, description)
    config: Config = parsed.fields
    _remember(prog, parsed.options, getattr(parsed.options, "run_dir", None) or Path("runs") / config.name)
    for name in ("train", "tokenizer_train"):
        loop = getattr(config, name)
        flag = f"--{name.replace('_', '-')}"
        require(
            not loop.curriculum or loop.steps == getattr(preset, name).steps,
            f"{flag}.steps changes nothing, as the epochs of {flag}.curriculum determine the steps; "
            f"{flag}.curriculum [] trains on all clips for that many steps",
        )
    return config, parsed.options


def choose_sections(preset: Config, argv: Sequence[str]) -> tuple[Config, list[str]]:
    """Chooses the sections that arguments name, such as ``--model.mask off`` or ``--train.optimizer adamw``.

    An argument within a section that is off switches it on.

    Returns:
        The preset with these sections, and the other arguments.

    Raises:
        ConfigError: a section has no such choice, or the sections do not fit together.
    """
    sections = {name: field for name, field in config_fields(preset).items() if field.section}
    words: dict[str, Any] = {}
    inside: list[str] = []
    rest: list[str] = []
    remaining = iter(argv)
    for argument in remaining:
        flag, equals, word = argument.partition("=")
        name = flag.removeprefix("--").replace("-", "_")
        if not flag.startswith("--") or name not in sections:
            inside.append(name)
            rest.append(argument)
            continue
        if not equals:
            word = next(remaining, "")
        choices = get_args(sections[name].kind)
        require(word in choices, f"{flag} is {word!r}; choose {' or '.join(choices)}")
        words[name] = word
    return with_sections(with_values(preset, words), inside), rest


def parse_options(argv: Sequence[str], prog: str, description: str, options: Options) -> Options:
    """Parses the arguments of a command without a preset. Arguments and errors as in :func:`parse`."""
    command.refuse_repeated(argv, _adding(options))
    if {"-h", "--help"}.intersection(argv):
        _show_help({"options": options}, prog, description)
    parsed = _parse({"options": options}, argv, prog, description).options
    _remember(prog, parsed)
    return parsed


def with_first_screen(head: str, prog: str, text: str) -> str:
    """Returns the head of a command's help with its example, output and most used options.

    Args:
        head: the usage and the description.
        prog: the command as the user types it; one without a first screen keeps the head as it is.
        text: the whole help, which describes the options.
    """
    screen = _screen(prog)
    if screen is None:
        return head
    lines = [head.rstrip(), "", f"Example:  {screen.example}", f"Output:   {screen.output}"]
    if screen.takes:
        lines.append(f"Time:     {screen.takes}")
    if screen.used:
        lines += ["", "Used most:"]
    for option in screen.used:
        match = re.search(rf"^  (?:-\w, )?--{re.escape(option)}(?:[ ,\n].*\n?)(?:   .*\n)*", text, re.MULTILINE)
        if match:  # a preset may lack a field
            lines += [line.rstrip() for line in match[0].splitlines()]
    return "\n".join(lines)


@contextlib.contextmanager
def main_errors() -> Iterator[None]:
    """Does what :func:`rsjax.command.main_errors` does, and says at the end how long it took and what to do next.

    The last line is on standard error, so that a program can read what the command prints. Of several processes that
    train together, the first one says it.
    """
    began = time.monotonic()
    with command.main_errors():
        _called.clear()
        yield
        screen = _screen(_called.get("prog", ""))
        if screen is None or not screen.following or not command.is_lead():
            return
        from rsjax.progress import duration

        following = screen.following.format(run=_called["run"])
        if _called["showed"]:
            following = f"the same command without {_called['showed']} does it"
        print(f"done in {duration(time.monotonic() - began)}; next: {following}", file=sys.stderr)


_called: dict[str, str] = {}  # the command that runs, and what it runs on


def _remember(prog: str, options: Any, run: Path | None = None) -> None:
    """Notes what the command was called with, for its last line."""
    for name in ("made_run", "run", "runs", "store"):
        value = getattr(options, name, None)
        if run is None and value:
            run = value[0] if isinstance(value, tuple) else value
    showed = next((f"--{_flag(name)}" for name in SHOWING if getattr(options, name, False)), "")
    _called.update(prog=prog, run=str(run or "RUN"), showed=showed)


def _screen(prog: str) -> FirstScreen | None:
    """Returns the first screen of a command as the user types it, such as ``rsjax play`` or ``rsjax store merge``."""
    _, *words = prog.split() or [""]
    return FIRST_SCREENS.get(" ".join(words[:2])) or FIRST_SCREENS.get(" ".join(words[:1]))


def _show_help(parts: dict[str, Any], prog: str, description: str) -> NoReturn:
    """Prints the help for these parts with the command's first screen, and stops."""
    text = _help(parts, prog, description)
    head, line, body = text.partition("\n positional arguments")
    if not line:
        head, line, body = text.partition("\n options")
    print(f"{with_first_screen(head, prog, text)}\n{line}{body}", end="")
    raise SystemExit(0)


def _help(parts: dict[str, Any], prog: str, description: str) -> str:
    """Returns the help for these parts."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        _parse(parts, ["--help"], prog, description)
    return text.getvalue()


def part(options: Any, kind: type[Options]) -> Options:
    """Returns the part of a command's options that they inherit from the class ``kind``."""
    return kind(**{field.name: getattr(options, field.name) for field in dataclasses.fields(kind)})  # type: ignore[arg-type]


def _adding(options: Any) -> list[str]:
    """Returns the names of the options that may be repeated, because their values are collected."""
    hints = get_type_hints(type(options), include_extras=True)
    return [name.replace("_", "-") for name, hint in hints.items() if tyro.conf.UseAppendAction in get_args(hint)]


def _parse(parts: dict[str, Any], argv: Sequence[str], prog: str, description: str, rest: bool = False) -> Any:
    """Parses arguments into dataclasses like those in ``parts``; with ``rest``, skips arguments that no part has.

    Flags are named after fields, without the part's name. A boolean in the part "fields" takes a value, False or True.
    """
    markers = {name: [tyro.conf.arg(name="")] for name in parts}
    markers.get("fields", []).extend([tyro.conf.FlagConversionOff, tyro.conf.AvoidSubcommands])
    kinds = [(name, Annotated[(type(part), *markers[name])]) for name, part in parts.items()]  # type: ignore[misc]
    default: Any = dataclasses.make_dataclass("Command", kinds)(**parts)

    settings: dict[str, Any] = {"args": argv, "default": default, "prog": prog, "description": description}
    settings |= {"registry": REGISTRY, "return_unknown_args": rest, "add_help": not rest}
    report = io.StringIO()
    try:
        with contextlib.redirect_stderr(report):
            parsed: Any = tyro.cli(type(default), **settings)
    except SystemExit as stop:
        if not stop.code:  # after --help
            raise
        raise ConfigError(f"{_one_line(report.getvalue(), parts)} (see {prog} --help)") from None
    except BrokenPipeError:  # --help-all | head
        os._exit(0)
    if rest:
        parsed = parsed[0]
    if "options" in parts:
        check_numbers(parsed.options, "--", dash=True)
        hints = get_type_hints(type(parsed.options), include_extras=True)
        for field in dataclasses.fields(parsed.options):  # directories and files that the command will write
            path = getattr(parsed.options, field.name)
            named = field.name in PLACES and tyro.conf.Positional not in get_args(hints[field.name])
            if named and isinstance(path, Path) and path != field.default:
                check_place(path, f"--{_flag(field.name)}", PLACES[field.name] == "directory")
    return parsed


def _one_line(report: str, parts: dict[str, Any]) -> str:
    """Returns the first paragraph of tyro's report on a mistake; it names the nearest flag and what is missing."""
    words: list[str] = []
    for line in report.splitlines()[1:]:  # the first is a title
        text = line.strip("│ ")
        if any(letter.isalnum() for letter in text):
            words += text.split()
        elif words:
            break
    message = " ".join(words).removeprefix("Error parsing ").replace("'options.", "'")
    if message.startswith("Missing from"):
        fields = [field for part in parts.values() for field in dataclasses.fields(part)]
        return f"missing {' or '.join(_flag(f.name).upper() for f in fields if f.default is tyro.MISSING)}"
    if not message.startswith("Unrecognized options: "):
        return message
    unknown = message.removeprefix("Unrecognized options: ").partition(", ")[0]
    flags = [_flag(name) for part in parts.values() for name in config_fields(part)]
    return f"unknown argument {unknown!r}{did_you_mean(_flag(unknown.partition('=')[0].lstrip('-')), flags, '--')}"


def _flag(name: str) -> str:
    return name.replace("_", "-")


def _first_fields(preset: Config) -> Any:
    """Returns a dataclass of the FIRST_FIELDS that the preset has, with the preset's values, for ``--help``."""
    kinds: list[Any] = []
    values: dict[str, Any] = {}
    for name, text in FIRST_FIELDS.items():
        section, _, field = name.replace("-", "_").rpartition(".")
        try:
            part = attrgetter(section)(preset)
            value = getattr(part, field)
        except AttributeError:
            continue
        key = f"{section}_{field}".replace(".", "_")
        kinds.append((key, Annotated[get_type_hints(type(part))[field], tyro.conf.arg(name=name, help=text)]))
        values[key] = value
    return dataclasses.make_dataclass("FirstFields", kinds)(**values)
