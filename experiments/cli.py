"""How every command reads its arguments and reports its errors."""

import contextlib
import dataclasses
import errno
import io
import os
import sys
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from rsjax.config import Config, ConfigError, StageConfig, presets
from rsjax.config.stages import GRAMMAR, format_stage, parse_stage
from rsjax.errors import Preempted, UserError, did_you_mean
from rsjax.runtime import sigterm_stops

Options = TypeVar("Options")

CONSTRUCTORS = tyro.constructors.ConstructorRegistry()


@CONSTRUCTORS.primitive_rule
def _stage(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec | None:
    """A curriculum's stage is one word, such as ``difficult:3:restart``."""
    if info.type is not StageConfig:
        return None
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=GRAMMAR,
        instance_from_str=lambda words: parse_stage(words[0]),
        is_instance=lambda value: isinstance(value, StageConfig),
        str_from_instance=lambda stage: [format_stage(stage)],
    )


def parse(argv: Sequence[str], prog: str, description: str, options: Options) -> tuple[Config, Options]:
    """Reads ``PRESET [--option VALUE] [--section.field VALUE]``.

    Args:
        argv: the arguments, without the program's name.
        prog: the command as the user types it, ``python -m experiments.train``.
        description: what the command does, for ``--help``.
        options: a dataclass of the command's own options, with their defaults. Where it has ``store`` and one is named,
            the preset is fitted to the clips of that store before its fields are set.

    Returns:
        The preset with its overrides, checked, and the options.

    Raises:
        ConfigError: an unknown preset or field, a value that does not parse, or an impossible combination.
    """
    usage = f"usage: {prog} PRESET [--section.field VALUE]; presets: {', '.join(presets.PRESETS)}"
    if not argv or argv[0].startswith("-"):
        if not {"-h", "--help"}.intersection(argv):
            raise ConfigError(f"name a preset first; {usage}")
        print(f"{usage}\n{description}\nEvery option and field: {prog} tiny --help")
        raise SystemExit(0)
    preset = presets.get(argv[0])
    if hasattr(options, "store") and (store := _named(argv, "store")):
        from rsjax.pipeline.own_data import on_store

        preset = on_store(preset, Path(store))
    command: Any = dataclasses.make_dataclass(
        "Command",
        [
            ("options", Annotated[type(options), tyro.conf.arg(name="")]),  # type: ignore[misc]
            # A field is set by value (--loss.keypoints False), so that one form fits every field.
            ("config", Annotated[Config, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff]),
        ],
    )
    known = _fields(options) + _fields(preset)
    parsed = _parse(command, command(options, preset), argv[1:], f"{prog} {argv[0]}", description, known)
    return parsed.config, parsed.options


def parse_options(argv: Sequence[str], prog: str, description: str, options: Options) -> Options:
    """Reads the arguments of a command that takes no preset. Arguments and errors as in :func:`parse`."""
    return _parse(type(options), options, argv, prog, description, _fields(options))


@contextlib.contextmanager
def main_errors() -> Iterator[None]:
    """Turns errors that the user can cure into one line on standard error and an exit status, without a traceback.

    Around a command's main function, as a decorator or in a ``with``. Exits with 2 for most :class:`UserError`, a full
    disk or a missing permission, with 130 for an interrupt, and with 75 (to be started again) for SIGTERM. Any other
    exception is a bug and keeps its traceback.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files need not be text
    try:
        with sigterm_stops():
            yield
    except KeyboardInterrupt:
        _exit("interrupted; the same command resumes", 130)
    except Preempted as stop:
        _exit(str(stop), os.EX_TEMPFAIL)
    except UserError as error:
        _exit(f"error: {error}", error.status)
    except Exception as error:
        cure = _cure(error)
        if cure is None:
            raise
        _exit(f"error: {cure}", 2)


def _cure(error: Exception) -> str | None:
    where = f" at {error.filename}" if isinstance(error, OSError) and error.filename else ""
    # Orbax, TensorStore and ArrayRecord report a full disk in errors of their own.
    if getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT) or "No space left on device" in str(error):
        return f"disk full{where}; free some space or choose another directory: the same command resumes"
    if isinstance(error, PermissionError) or getattr(error, "errno", None) == errno.EROFS:
        return f"no permission to write or read{where}; choose another directory or change its owner"
    return None


def _exit(line: str, status: int) -> None:
    print(" ".join(line.split()), file=sys.stderr)
    if status == UserError.status and _one_of_several():
        # jax waits for the other processes at the end of this one, in vain, and then aborts with a status of its own.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    raise SystemExit(status)


def _one_of_several() -> bool:
    distributed = sys.modules.get("rsjax.training.distributed")
    return distributed is not None and distributed.jax.distributed.is_initialized()


def _parse(kind: Any, default: Any, argv: Sequence[str], prog: str, description: str, known: list[str]) -> Any:
    captured = io.StringIO()
    try:
        with contextlib.redirect_stderr(captured):
            parsed, unknown = tyro.cli(
                kind,
                args=argv,
                default=default,
                prog=prog,
                description=description,
                return_unknown_args=True,
                registry=CONSTRUCTORS,
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise ConfigError(f"{_one_line(captured.getvalue())} (see {prog} --help)") from None
    if unknown:
        word = unknown[0].partition("=")[0].lstrip("-").replace("_", "-")
        raise ConfigError(f"unknown argument {unknown[0]!r}{did_you_mean(word, known, '--')} (see {prog} --help)")
    return parsed


def _named(argv: Sequence[str], name: str) -> str | None:
    """The value of an option that is wanted before the others are read; the last one counts."""
    found = None
    for word, after in zip(argv, [*argv[1:], ""], strict=True):
        if word == f"--{name}":
            found = after
        elif word.startswith(f"--{name}="):
            found = word.partition("=")[2]
    return found


def _one_line(report: str) -> str:
    """The message out of tyro's report: a title, the message, the argument's help and a hint, boxed or ruled off."""
    lines = [line.strip("│╭╮╰╯ ") for line in report.splitlines()[1:]]
    blocks = [" ".join(group) for rule, group in groupby(lines, lambda line: set(line) <= set("-─")) if not rule]
    return " ".join((blocks or [report])[0].split())


def _fields(value: Any, prefix: str = "") -> list[str]:
    """Flags of a dataclass's fields and of those nested in it, without their leading dashes."""
    names: list[str] = []
    for field in dataclasses.fields(value):
        inner, name = getattr(value, field.name), prefix + field.name.replace("_", "-")
        names += _fields(inner, f"{name}.") if dataclasses.is_dataclass(inner) else [name]
    return names
