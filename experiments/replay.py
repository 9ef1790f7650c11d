"""Looks into a training step that was left out. ``python -m experiments.replay runs/tiny --step 812``"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from experiments.cli import main_errors, parse_options
from rsjax.runtime import tune_process


@dataclass(frozen=True)
class Options:
    """Lists the steps whose loss or gradient was not finite, or goes through the clips of one of them."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory, made by experiments.train."""
    step: int | None = None
    """The step to go through; all are listed if not given."""
    stage: Literal["world_model", "tokenizer"] = "world_model"
    """What was trained."""
    data_dir: Path = Path("data")
    """Where the run's data set is kept, if it was simulated."""
    store: Path | None = None
    """Where the run's store of clips lies now, if it was ingested and has moved since."""


@main_errors()
def main() -> None:
    """Prints a line per step, or a line per clip of one step."""
    tune_process()
    options = parse_options(sys.argv[1:], "python -m experiments.replay", Options.__doc__ or "", Options())
    from rsjax.pipeline.generator import load_config
    from rsjax.pipeline.own_data import relocated
    from rsjax.pipeline.replay import replay, skipped_steps
    from rsjax.pipeline.run import Run

    config = load_config(options.run)
    run = Run(relocated(config, options.store) if options.store else config, options.run, options.data_dir)
    if options.step is None:
        print("\n".join(skipped_steps(run, options.stage)) or f"{options.run}: no step of {options.stage} was left out")
        return
    for clip in replay(run, options.stage, options.step):
        told = ", ".join(f"{name} {value:.4g}" for name, value in clip.scalars.items())
        where = clip.source.get("file", "")
        mark = "" if clip.finite else "   <-- not finite"
        print(f"record {clip.source['record']} {where}: {told}{mark}")


if __name__ == "__main__":
    main()
