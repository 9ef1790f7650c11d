"""Injects faults into the training command and compares the results. ``python -m benchmarks.soak tiny --minutes 30``"""

import dataclasses
import shlex
import sys
from collections.abc import Sequence
from functools import partial

from benchmarks.soak.runs import Options, Soak, without
from benchmarks.soak.soak import run_soak
from benchmarks.soak.table import markdown, passed
from rsjax.tools.commands.cli import main_errors, parse

PROG = "python -m benchmarks.soak"


@main_errors()
def main() -> None:
    """Soaks, prints the result, and exits with 1 if a fault was not survived or a run ended differently."""
    argv = sys.argv[1:]
    config, options = parse(argv, PROG, "Kills, stops and damages runs, and compares the results.", Options())
    soak = Soak(config, training_arguments(argv), options)
    result = run_soak(soak, shlex.join([*PROG.split(), *argv]), partial(print, flush=True))
    print(f"{markdown(result)}\nsoak: {(soak.out / 'soak.md').absolute()}")
    if not passed(result):
        raise SystemExit(1)


def training_arguments(argv: Sequence[str]) -> tuple[str, ...]:
    """Returns the arguments for ``experiments.train``: those that are not options of this command alone."""
    own = {f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(Options)}
    return without(argv, own)


if __name__ == "__main__":
    main()
