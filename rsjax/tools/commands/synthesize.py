"""Makes synthetic demonstrations with a world model. ``rsjax synthesize runs/tiny --demos 200``"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options, part
from rsjax.tools.policies.studies.synthesis import CLIPS, Synthesis


@dataclass(frozen=True)
class Options(Synthesis):
    """Generates videos from a data set's first frames and actions; writes them as a store and as LeRobotDatasets."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory, made by rsjax train; with --store also a saved model."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    store: Path | None = None
    """A store of clips to start from; default: the run's own."""
    out: Path | None = None
    """Directory of the demonstrations; default RUN/synthetic."""
    judge: bool = False
    """Label success with the run's judge (rsjax judge)."""


@main_errors()
def main() -> None:
    """Writes the demonstrations and prints where they are."""
    tune_process()
    options = parse_options(sys.argv[1:], "rsjax synthesize", Options.__doc__ or "", Options())
    from rsjax.data.store import open_store
    from rsjax.model_directory import locate, output_directory
    from rsjax.progress import Progress
    from rsjax.tools.pipeline.limits import check_together
    from rsjax.tools.policies.run_data import RunData, with_clips
    from rsjax.tools.policies.studies.synthesis import synthesize
    from rsjax.tools.policies.worlds.actions import action_range

    if not options.store:
        with_clips(options.run, ", or a store of clips with --store")
    run = RunData(locate(options.run), options.data_dir)
    check_together(run.config, options.batch, run.config.clips.frames, f"--batch {options.batch}")
    out = options.out or output_directory(run.run, "synthetic")
    store = open_store(options.store) if options.store else run.clips
    limits = action_range(run.config, run.trained.assets.normalization)
    judge = run.judge() if options.judge else None
    with Progress("synthesize", options.demos, "demos") as progress:
        made = synthesize(
            run.trained,
            store,
            out,
            part(options, Synthesis),
            limits,
            judge=judge,
            report=lambda done, total: progress.update(done),
        )
    counts = f"{made['success']} of them judged a success, {made['uninterpretable']} uninterpretable"
    labelled = "" if made["success"] is None else f", {counts}"
    print(f"{made['demos']} demonstrations from {made['sources']} clips{labelled}; {made['clipped']} numbers clipped")
    print(*(out / name for name in (CLIPS, "lerobot-v3.0", "lerobot-v2.1")), sep="\n")
