"""Disturbs the training command until it fails, or does not. ``python -m experiments.soak tiny --minutes 30``"""

import dataclasses
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.cli import main_errors, parse

PROG = "python -m experiments.soak"


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    minutes: float = 30.0
    """For how long runs are disturbed; the reference, and the end of the last run, come on top."""
    seed: int = 0
    """Of the disturbances."""
    stage: Literal["world_model", "tokenizer", "all"] = "world_model"
    """What is disturbed; the stages before are taken from the reference."""
    out: Path | None = None
    """Where all of it is kept; runs/soak-PRESET if not given."""
    store: Path | None = None
    """A store of clips to train on instead of simulated ones, made by experiments.ingest."""
    data_dir: Path = Path("data")
    """Where the reference's clips are kept, if they were simulated."""
    reference: Path | None = None
    """A finished run of the same configuration that was never stopped; made first if not given."""
    checkpoint_every: int = 0
    """Steps between the checkpoints of disturbed runs; 0: a fortieth of the run."""


@main_errors()
def main() -> None:
    """Soaks, prints a table, and exits with 1 if anything was not survived or came out differently."""
    argv = sys.argv[1:]
    config, options = parse(argv, PROG, "Kills, stops and damages runs, and compares what comes out.", Options())
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from rsjax.soak.runs import Plan
    from rsjax.soak.soak import soak
    from rsjax.soak.table import HEADER, conclusion, passed, rows

    console = Console()
    out = options.out or Path("runs") / f"soak-{config.name}"
    plan = Plan(
        config,
        training_arguments(argv),
        options.stage,
        out,
        options.data_dir,
        options.reference,
        options.minutes,
        options.seed,
        options.checkpoint_every,
    )
    say = lambda line: console.print(line, markup=False, highlight=False, soft_wrap=True)  # noqa: E731
    result = soak(plan, shlex.join([*PROG.split(), *argv]), say)
    table = Table(*HEADER, box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    for row in rows(result["rounds"]):
        table.add_row(*row)
    console.print(table)
    for line in [*conclusion(result), f"soak: {(out / 'soak.md').absolute()}"]:
        say(line)
    if not passed(result):
        raise SystemExit(1)


def training_arguments(argv: Sequence[str]) -> tuple[str, ...]:
    """The arguments without those that this command alone has: what ``experiments.train`` is given."""
    own = {f"--{field.name}" for field in dataclasses.fields(Options) if field.name != "store"}
    kept, words = [], iter(argv)
    for word in words:
        if word.partition("=")[0].replace("_", "-") not in {name.replace("_", "-") for name in own}:
            kept.append(word)
        elif "=" not in word:
            next(words, None)  # its value
    return tuple(kept)


if __name__ == "__main__":
    main()
