"""Replays a skipped training step. ``rsjax replay runs/tiny --step 812``"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options


@dataclass(frozen=True)
class Options:
    """Lists the skipped steps, whose loss or gradient was not finite, or the clips of one of them."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory, made by rsjax train."""
    step: int | None = None
    """The step whose clips are listed; default: list all skipped steps."""
    stage: Literal["world_model", "tokenizer"] = "world_model"
    """The training stage."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    store: Path | None = None
    """The new path of the run's store of ingested clips, if it was moved."""


@main_errors()
def main() -> None:
    """Prints a line per skipped step, or a line per clip of one step."""
    tune_process()
    options = parse_options(sys.argv[1:], "rsjax replay", Options.__doc__ or "", Options())
    from rsjax.models.load_run import load_config
    from rsjax.tools.pipeline.replay import replay, skipped_steps
    from rsjax.tools.pipeline.run import Run
    from rsjax.tools.pipeline.run_clips import relocated

    config = load_config(options.run)
    if options.store:
        config = relocated(config, options.store)
    run = Run(config, options.run, options.data_dir)
    if options.step is None:
        print("\n".join(skipped_steps(run, options.stage)) or f"{options.run}: no step of {options.stage} was skipped")
        return
    for clip in replay(run, options.stage, options.step):
        scalars = ", ".join(f"{name} {value:.4g}" for name, value in clip.scalars.items())
        file = clip.source.get("file", "")
        mark = ""
        if not clip.finite:
            mark = "   <-- not finite"
        print(f"record {clip.source['record']} {file}: {scalars}{mark}")
