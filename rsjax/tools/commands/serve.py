"""Serves a world model to other programs over a WebSocket. ``rsjax serve tiny``"""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options


@dataclass(frozen=True)
class Options:
    """Serves a run's world model to programs: reset, step and generate, as openpi serves policies (docs/serve.md)."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A run directory, made by rsjax train, or tiny or multitask, the package's models."""
    data_dir: Path = Path("data")
    """Directory of simulated data sets."""
    store: Path | None = None
    """The new path of the run's store of ingested clips, if it was moved."""
    split: Literal["test", "train"] = "test"
    """The split of the clips that episodes begin with."""
    host: str = "127.0.0.1"
    """The address to listen at; any but this machine's own requires a secret in the variable RSJAX_TOKEN."""
    port: int = 8643
    """The port; 0: a free one."""
    clients: int = 16
    """Largest number of clients at a time."""
    lanes: int = 0
    """Steps of different clients generated in one pass; 0: 8 on an accelerator, 1 on a CPU."""
    frames: int = 256
    """Largest number of frames of an episode or a generated video."""
    idle_minutes: float = 30.0
    """Minutes without a message after which a client is disconnected."""


@main_errors()
def main() -> None:
    """Serves until Ctrl-C."""
    tune_process()
    options = parse_options(sys.argv[1:], "rsjax serve", Options.__doc__ or "", Options())
    from rsjax.model_directory import locate
    from rsjax.tools.play.play_run import PlayRun
    from rsjax.tools.policies.run_data import RunData
    from rsjax.tools.serve.server import WorldServerSettings, serve_world

    settings = WorldServerSettings(
        host=options.host,
        port=options.port,
        token=os.environ.get("RSJAX_TOKEN", ""),
        clients=options.clients,
        lanes=options.lanes,
        frames=options.frames,
        idle_minutes=options.idle_minutes,
    )
    data = RunData(locate(options.run), options.data_dir, options.store)
    serve_world(PlayRun(data, options.split), settings)
