"""Trains a world model from data to report. ``rsjax train tiny``"""

import shlex
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse

PROG = "rsjax train"


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    run_dir: Path | None = None
    """Directory of the run; default runs/PRESET."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets, which runs share."""
    resume: bool = True
    """Resume an interrupted stage from its checkpoints; --no-resume starts the stage over."""
    overwrite: bool = False
    """Train stages of the run directory again if they were trained with another configuration."""
    coordinator: str = ""
    """HOST:PORT of process 0 to train on several hosts; not needed with Slurm, Open MPI or TPU pods."""
    processes: int | None = None
    """Number of processes, with --coordinator."""
    process_id: int | None = None
    """Number of this process, from 0, with --coordinator."""


@main_errors()
def main() -> None:
    """Runs all unfinished stages."""
    tune_process()
    config, options = parse(sys.argv[1:], PROG, "Collects episodes, trains, generates, evaluates, reports.", Options())
    # JAX is imported only after the arguments are checked.
    from rsjax.training import distributed

    distributed.initialize(options.coordinator, options.processes, options.process_id)
    from rsjax.evaluation.verdict import verdict
    from rsjax.files import read_json
    from rsjax.tools.pipeline.run import Run
    from rsjax.tools.pipeline.stages import run_all

    run = Run(config, options.run_dir or Path("runs") / config.name, options.data_dir)
    with ExitStack() as stack:
        distributed.on_lead("run directory", stack.enter_context, run.locked())
        distributed.on_lead("run directory", run.prepare, options.overwrite)
        run_all(run, options.resume, command=shlex.join([*PROG.split(), *sys.argv[1:]]))
    if distributed.is_lead():
        print(verdict(read_json(run.directory / "metrics.json")))
        print(f"report: {run.output('report').absolute()}")
