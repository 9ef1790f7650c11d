"""Writes clips or demonstrations in another project's format. ``rsjax export lerobot STORE OUT``"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from rsjax.config import ConfigError
from rsjax.tools.commands.cli import main_errors, parse_options
from rsjax.tools.export.demonstrations import DemonstrationOptions, export_libero
from rsjax.tools.export.lerobot import LeRobotOptions, export_lerobot, openpi_advice

PROG = "rsjax export"


@dataclass(frozen=True)
class Options(LeRobotOptions):
    """Options of this command: the store, the new data set, and how it is written."""

    store: Annotated[Positional[Path], arg(metavar="STORE")] = tyro.MISSING
    """A store of clips."""
    out: Annotated[Positional[Path], arg(metavar="OUT")] = tyro.MISSING
    """Directory of the new data set, which must not exist."""


@dataclass(frozen=True)
class LiberoOptions(DemonstrationOptions):
    """Options of ``export libero``: the new data set, and what it has."""

    out: Annotated[Positional[Path], arg(metavar="OUT")] = tyro.MISSING
    """Directory of the new data set, which must not exist."""


@main_errors()
def main() -> None:
    """Writes the data set and prints what it contains."""
    word, *argv = sys.argv[1:] or [""]
    if word == "libero":
        export_demonstrations(argv)
        return
    if word != "lerobot" and not {"-h", "--help"} & {word}:
        raise ConfigError(f"name a format first; usage: {PROG} lerobot STORE OUT; formats: lerobot, libero")
    if word != "lerobot":
        argv = ["--help"]
    options = parse_options(argv, f"{PROG} lerobot", "Writes a store as a LeRobotDataset.", Options())
    from rsjax.data.store import open_store
    from rsjax.progress import Progress

    store = open_store(options.store)
    with Progress("export", sum(store.counts().values()), "episodes") as progress:
        info = export_lerobot(store, options.out, options, lambda done, total: progress.update(done))
    counts = ", ".join(f"{info[f'total_{name}']} {name}" for name in ("episodes", "frames", "tasks"))
    print(f"{options.out.absolute()}: LeRobotDataset {options.version}, {counts}, {info['fps']:g} fps")
    advice = openpi_advice(round(info["total_frames"] / info["total_episodes"]))
    if options.version == "v2.1" and advice:
        print(advice)


def export_demonstrations(argv: list[str]) -> None:
    """Simulates demonstrations with the keys of openpi's data of LIBERO, and prints what they are."""
    about = "Simulates demonstrations of several tasks, and writes them as openpi's configuration of LIBERO reads them."
    options = parse_options(argv, f"{PROG} libero", about, LiberoOptions())
    from rsjax.progress import Progress

    with Progress("export", options.demos, "demonstrations") as progress:
        info = export_libero(options.out, options, lambda done, total: progress.update(done))
    counts = ", ".join(f"{info[f'total_{name}']} {name}" for name in ("episodes", "frames", "tasks"))
    print(f"{options.out.absolute()}: LeRobotDataset {options.version}, {counts}, {info['fps']:g} fps")
