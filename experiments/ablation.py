"""A grid of runs and its table. ``python -m experiments.ablation tiny --grid model.depth=True,False --seeds 0 1 2``"""

import os
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from experiments.cli import main_errors, parse
from rsjax.ablation.grid import DEFAULT_AXES, Choice, expand, parse_axes, task_number
from rsjax.runtime import tune_process

PROG = "python -m experiments.ablation"


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    grid: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """FIELD=VALUE,VALUE…: a field to vary, once per field; depth on/off and keypoints on/off if none is given."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the world model's training (train.seed); every combination is run with each."""
    out: Path | None = None
    """Where the grid is kept, a run directory per cell; runs/ablation-PRESET if not given."""
    data_dir: Path = Path("data")
    """Where simulated data sets are kept, to be shared by runs."""
    only: tuple[str, ...] = ()
    """Cells to run, by name or shell pattern ('model.depth=True,*'); all if not given."""
    skip: tuple[str, ...] = ()
    """Cells to leave out, likewise."""
    cell: int | None = None
    """Run the cell of this number alone, counted from 0; in a Slurm array job the task's number if not given."""
    list: bool = False
    """Name the cells with their numbers and how far they are, and run nothing."""
    table: bool = False
    """Write and print the table of what is there, for all cells that the directory was ever asked for; run nothing."""


@main_errors()
def main() -> None:
    """Runs the cells that are not finished, then prints the table; exits with 1 where a cell failed."""
    tune_process()
    config, options = parse(sys.argv[1:], PROG, "Runs a grid of configurations and compares them.", Options())
    out, data = options.out or Path("runs") / f"ablation-{config.name}", options.data_dir
    cells = expand(config, parse_axes(config, options.grid or DEFAULT_AXES), options.seeds)
    number = options.cell if options.cell is not None or options.list else task_number(os.environ)
    choice = Choice(number, options.only, options.skip)
    # JAX is loaded only now, after arguments are known to be good.
    from rsjax.ablation import output, runner

    if options.table:
        output.print_table(out, data)
    elif options.list:
        output.print_cells(config, cells, choice, out, data)
    else:
        states = runner.run_grid(config, cells, choice, out, data, shlex.join([*PROG.split(), *sys.argv[1:]]))
        output.print_table(out, data)
        if "failed" in states.values():
            raise SystemExit(1)


if __name__ == "__main__":
    main()
