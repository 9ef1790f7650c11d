"""The main job: episodes in, a trained world model and a report out. ``python -m experiments.train tiny``"""

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from experiments.cli import main_errors, parse
from rsjax.runtime import tune_process

PROG = "python -m experiments.train"


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    run_dir: Path | None = None
    """Where the run is kept; runs/PRESET if not given."""
    data_dir: Path = Path("data")
    """Where simulated data sets are kept, to be shared by runs."""
    resume: bool = True
    """Go on from the checkpoints of an interrupted stage; --no-resume starts that stage over."""
    overwrite: bool = False
    """Train again the stages that the run directory holds under another configuration."""
    wandb: str = ""
    """Log to this Weights & Biases project as well; WANDB_MODE=offline keeps it on disk."""
    profile: int = 0
    """Trace so many steps of each training stage, into its directory."""
    coordinator: str = ""
    """HOST:PORT of process 0 where several hosts train together; Slurm, Open MPI and TPU pods are asked instead."""
    processes: int | None = None
    """How many processes there are, with --coordinator."""
    process_id: int | None = None
    """Which of them this is, 0 and up, with --coordinator."""


@main_errors()
def main() -> None:
    """Runs all stages that are not finished."""
    tune_process()
    config, options = parse(sys.argv[1:], PROG, "Collects episodes, trains, generates, evaluates, reports.", Options())
    config = config.with_loops(**{n: value for n in ("wandb", "profile") if (value := getattr(options, n))})
    # JAX is loaded only now, after arguments are known to be good.
    from rsjax.training import distributed

    distributed.initialize(options.coordinator, options.processes, options.process_id)
    from rsjax.pipeline.run import Run
    from rsjax.pipeline.stages import run_all

    run = Run(config, options.run_dir or Path("runs") / config.name, options.data_dir)
    distributed.on_lead("run directory", lambda: run.prepare(options.overwrite))
    run_all(run, options.resume, command=shlex.join([*PROG.split(), *sys.argv[1:]]))
    if distributed.is_lead():
        print(f"report: {run.output('report').absolute()}")


if __name__ == "__main__":
    main()
