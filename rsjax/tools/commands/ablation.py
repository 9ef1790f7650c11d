"""Runs a grid and compares it. ``rsjax ablation tiny --grid model.depth=branch,head,none``"""

import os
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rsjax.config import require
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse
from rsjax.tools.studies.ablation.grid import Choice, chosen_grid

PROG = "rsjax ablation"
TASK = "SLURM_ARRAY_TASK_ID"


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    grid: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """FIELD=VALUE,VALUE…: a field to vary; repeat the option for more. Or a named grid: physics (how depth is used ×
    the keypoint term; the default) or weights (λ₁, λ₂, λ₃, γ, K and N₀, one at a time)."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the world model's training (train.seed); every combination runs with each."""
    out: Path | None = None
    """Directory of the grid, with a run directory per cell. Default: runs/ablation-PRESET."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets, which runs share."""
    only: tuple[str, ...] = ()
    """Cells to run, by name or shell pattern ('model.depth=head,*'). Default: all."""
    skip: tuple[str, ...] = ()
    """Cells to leave out, by name or shell pattern."""
    cell: int | None = None
    """Run only the cell with this number, counted from 0. Default in a Slurm array job: the task's number."""
    list: bool = False
    """Print the cells with their numbers and states, and run nothing."""
    table: bool = False
    """Write and print the table of all cells in the directory as they are now, and run nothing."""


@main_errors()
def main() -> None:
    """Runs the cells that are not finished, then prints the table; exits with 1 if a cell failed."""
    tune_process()
    config, options = parse(sys.argv[1:], PROG, "Runs a grid of configurations and compares them.", Options())
    out = options.out or Path("runs") / f"ablation-{config.name}"
    data = options.data_dir
    grid = chosen_grid(config, options.grid or ("physics",), options.seeds)
    number = options.cell
    if number is None and not options.list and (task := os.environ.get(TASK)):
        require(
            task.isascii() and task.isdecimal(),
            f"{TASK} is {task!r}, not a cell's number; unset it, or choose with --cell",
        )
        number = int(task)
    choice = Choice(number, options.only, options.skip)
    # This import loads JAX, so it comes after the arguments have been checked.
    from rsjax.tools.studies.ablation import sweep

    if options.table:
        sweep.print_table(out, data)
    elif options.list:
        sweep.print_cells(grid, choice, out, data)
    else:
        states = sweep.run_sweep(grid, choice, out, data, shlex.join([*PROG.split(), *sys.argv[1:]]))
        sweep.print_table(out, data)
        if "failed" in states.values():
            raise SystemExit(1)
