"""Tests the paper's claims at small scale. ``rsjax paper --budget 3h``"""

import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from rsjax.config import SIMULATOR, presets, require
from rsjax.config.config_fields import with_values
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options
from rsjax.tools.studies.ablation.grid import MOST_SEEDS

PROG = "rsjax paper"
FILES = ("weights", "depth_estimator")  # fields of EvalConfig


@dataclass(frozen=True)
class Options:
    """Trains and evaluates what the paper's claims need and does not exist yet, and judges each claim.

    The budget determines how large the trainings are and which of them run; the same command continues where it was
    stopped. The report is written after each training.
    """

    budget: str = "3h"
    """Time that everything may take, on 2 CPU cores: 30min, 3h, 12h, 1h30min …"""
    size: str = ""
    """The budget that determines how large the trainings are, if another: --budget 12h --size 3h runs more of them."""
    only: tuple[str, ...] = ()
    """Claims to test, by name or shell pattern (table1, departure-*), which share the budget. Default: all."""
    dir: Path = Path("runs/paper")
    """Directory of trainings and report; several budgets can share it."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    preset: str = "roboscape_tiny"
    """The preset that the trainings vary."""
    seeds: int = 3
    """Trainings of each arm."""
    first_seed: int = 0
    """The first of the seeds, which count up; 3 with --seeds 2 trains the fourth and fifth."""
    vary: Literal["auto", "model", "everything"] = "auto"
    """What differs between the seeds: the training of the model alone, or clips and tokenizer too. Default: everything
    from a budget of 12 hours on, where it costs little."""
    weights: str = ""
    """A directory with the weights of LPIPS and FVD (docs/evaluation.md). Default: the preset's."""
    depth_estimator: str = SIMULATOR
    """What estimates depth (docs/evaluation.md): simulator, a small network that learns from the clips, or another."""
    dry_run: bool = False
    """Print the trainings with their estimated minutes and states, and run nothing."""
    report: bool = False
    """Write the report on what has finished, and run nothing."""


@main_errors()
def main() -> None:
    """Runs what has not finished, and prints the report's path; exits with 1 if a training failed."""
    tune_process()
    options = parse_options(sys.argv[1:], PROG, Options.__doc__ or "", Options())
    require(1 <= options.seeds <= MOST_SEEDS, f"--seeds is {options.seeds}; it must be 1 … {MOST_SEEDS}")
    require(options.first_seed >= 0, f"--first-seed is {options.first_seed}; it must be at least 0")
    files = {f"eval.{name}": getattr(options, name) for name in FILES if getattr(options, name)}
    preset = with_values(presets.get(options.preset), files)
    # This import loads JAX, so it comes after the arguments have been parsed.
    from rsjax.tools.studies.paper import run
    from rsjax.tools.studies.paper.budget import VARY_EVERYTHING, parse_duration, scale
    from rsjax.tools.studies.paper.claim import chosen, claims
    from rsjax.tools.studies.paper.plan import make_plan

    wanted = chosen(options.only, claims())
    seconds = parse_duration(options.budget)
    vary = options.vary
    if vary == "auto":
        vary = "everything" if seconds >= VARY_EVERYTHING else "model"
    size = seconds
    if options.size:
        size = parse_duration(options.size, "--size")
    sizes = scale(preset, size)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    plan = make_plan(wanted, replace(sizes, seconds=seconds), options.data_dir, seeds, vary)
    command = shlex.join([*PROG.split(), *sys.argv[1:]])
    run.print_plan(plan, options.dir, options.data_dir)
    if options.dry_run:
        return
    states = {} if options.report else run.run_plan(plan, options.dir, options.data_dir, command)
    page = run.write(plan, options.dir, options.data_dir, command)
    print(f"report: {page.absolute()} (and .md, .json)")
    if "failed" in states.values():
        raise SystemExit(1)
