"""Saves a finished run as a small directory to publish. ``rsjax save runs/tiny tiny``"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options

PROG = "rsjax save"


@dataclass(frozen=True)
class Options:
    """Writes config.json, model.safetensors, README.md (the card, from the run's records) and a few clips."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A finished run directory, made by rsjax train."""
    out: tyro.conf.Positional[Path] = tyro.MISSING
    """The new directory; a saved model that is there is replaced."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    store: Path | None = None
    """The new path of the run's store of ingested clips, if it was moved."""
    dtype: Literal["float16", "float32"] = "float16"
    """What the weights are stored as."""
    clips: int = 16
    """Held-out clips to put beside the weights, to play from and to test with."""
    measured: int = 64
    """Held-out clips on which to measure what rounding the weights costs; 0: do not measure."""
    license: str = ""
    """The license, as hubs name it, such as apache-2.0."""
    note: str = ""
    """A paragraph for the top of the card."""


@main_errors()
def main() -> None:
    """Saves the run, and prints the files and what was measured."""
    tune_process()
    options = parse_options(sys.argv[1:], PROG, Options.__doc__ or "", Options())
    from rsjax.models.load_run import load_config
    from rsjax.tools.pipeline.publishing import Publication, publish
    from rsjax.tools.pipeline.run import Run
    from rsjax.tools.pipeline.run_clips import relocated

    config = load_config(options.run)
    if options.store is not None:
        config = relocated(config, options.store)
    what = Publication(options.dtype, options.clips, options.measured, options.license, options.note)
    print(publish(Run(config, options.run, options.data_dir), options.out, what))
    files = sorted(path for path in options.out.rglob("*") if path.is_file())
    for path in files:
        print(f"{path.stat().st_size:>12,} bytes  {path}")
