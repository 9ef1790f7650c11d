"""Steers the robot inside generated video, in a browser. ``rsjax play tiny``"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options


@dataclass(frozen=True)
class Options:
    """Opens a page in which a person steers the robot and the run's model generates what follows (docs/play.md)."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory, made by rsjax train; a saved model; or tiny or multitask, the package's models."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    store: Path | None = None
    """The new path of the run's store of ingested clips, if it was moved."""
    split: Literal["test", "train"] = "test"
    """The split of the clips to start from."""
    policy: Path | None = None
    """A policy that can take over the controls, made by rsjax policy_learning."""
    host: str = "127.0.0.1"
    """The address to listen at; any but this machine's own requires a token, which is printed with the address."""
    port: int = 8642
    """The port; 0: a free one."""
    sessions: int = 8
    """Largest number of viewers at a time."""
    idle_minutes: float = 10.0
    """Minutes without a message or a new frame after which a session is freed; a page in view sends messages."""
    lanes: int = 1
    """Frames of different sessions generated in one pass; use more on a GPU. The number affects the last bits."""
    out: Path | None = None
    """Directory of videos and clips that viewers keep; default RUN/play, or runs/tiny/play for the package's model."""
    browser: bool = True
    """Open the page in a browser, if there is a display."""


@main_errors()
def main() -> None:
    """Serves the page until Ctrl-C."""
    tune_process()
    options = parse_options(sys.argv[1:], "rsjax play", Options.__doc__ or "", Options())
    from rsjax.model_directory import locate, output_directory
    from rsjax.tools.play.serve import ServeSettings, serve
    from rsjax.tools.policies.run_data import RunData

    run = locate(options.run)
    out = options.out or output_directory(run, "play")
    how = (options.host, options.port, options.sessions, options.idle_minutes, options.lanes, options.browser)
    serve(RunData(run, options.data_dir, options.store), options.policy, options.split, out, ServeSettings(*how))
