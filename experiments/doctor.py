"""Checks a data set and prints what is wrong where. ``python -m experiments.doctor rlds /data/bridge``"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from experiments.cli import main_errors, parse_options
from rsjax.config import ConfigError
from rsjax.ingest.formats import FORMATS

PROG = "python -m experiments.doctor"


@dataclass(frozen=True)
class Options:
    """Goes through a data set of any format, or a store of clips, and tells what is wrong with which episode.

    Exits with 0 where nothing is wrong, with 1 where something is, and with 2 where the data set cannot be listed.
    """

    what: tyro.conf.Positional[str] = tyro.MISSING
    """A store of clips, or a format: agibot, lerobot, robomimic, libero, rlds, bair, folder, sim."""
    path: tyro.conf.Positional[Path | None] = None
    """Where the data set of that format is."""
    option: tuple[str, ...] = ()
    """The format's own settings, such as keys=bridge or split=train; lists as JSON."""
    frames: int = 5
    """Pictures of each camera that are decoded, evenly spread over the episode; 0: all."""
    gap: float = 1.5
    """A time between two frames that is too long, relative to 1 / fps."""
    unusual: float = 20.0
    """An action, or a step of the state, that is too large, relative to the usual."""
    ignore: tuple[str, ...] = ()
    """Kinds of findings that are all right, such as no-task."""
    lines: int = 50
    """Findings that are printed; 0: all."""
    workers: int = 1
    """Processes that look at episodes; -1: one per core."""
    fix: Path | None = None
    """Writes a manifest here that leaves out every episode with a finding, with the reasons."""


@main_errors()
def main() -> None:
    """Prints a line per finding and a table of their kinds."""
    if len(sys.argv) < 2:
        raise ConfigError(
            f"name a store, or a source and its path, first; usage: {PROG} STORE, or {PROG} SOURCE PATH [--fix FILE]; "
            f"sources: {', '.join(FORMATS)}"
        )
    options = parse_options(sys.argv[1:], PROG, Options.__doc__ or "", Options())
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from experiments.ingest import source_options
    from rsjax.ingest.checks import KINDS, Thresholds
    from rsjax.ingest.doctor import examine, open_any
    from rsjax.ingest.jobs.pool import count_workers
    from rsjax.ingest.selection import write_selection

    console = Console()
    source = open_any(options.what, options.path, **source_options(options.option))
    with console.status("looking at episodes") as status:
        limits = Thresholds(options.frames, options.gap, options.unusual)
        tell = lambda done: status.update(f"looking at episodes: {done}")  # noqa: E731
        report = examine(source, limits, options.ignore, tell, count_workers(options.workers))
    shown = report.findings[: options.lines or None]
    for finding in shown:
        line = f"{finding.episode}: {finding.kind}: {finding.detail}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    if len(shown) < len(report.findings):
        console.print(f"… and {len(report.findings) - len(shown)} more; --lines 0 prints all", highlight=False)
    for name, told in report.mended[: max(0, options.lines - len(shown)) if options.lines else None]:
        console.print(f"{name}: mended: {told}", markup=False, highlight=False, soft_wrap=True)
    table = Table("kind", "episodes", "meaning", box=SIMPLE_HEAD, pad_edge=False)
    for kind, count in report.counts().items():
        table.add_row(kind, str(count), KINDS[kind])
    if report.findings:
        console.print(table)
    found, bad = len(report.refs), report.bad()
    common = [kind for kind, count in report.counts().items() if count == found]
    for kind in common:
        console.print(f"all are {kind!r}: if that is as it should be, --ignore {kind}", highlight=False)
    console.print(f"{found} episodes: {found - bad} without a finding, {bad} with", highlight=False)
    if report.mended:
        console.print(f"mended when they were read, which is no finding: {len(report.mended)}", highlight=False)
    if options.fix is not None:
        about = f"{source.name} {options.path or options.what}"
        kept, out = write_selection(options.fix, about, report.refs, report.reasons())
        line = f"{options.fix}: keeps {kept}, leaves out {out}" + ("" if kept else _nothing_left(common))
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    if report.findings:
        raise SystemExit(1)


def _nothing_left(common: list[str]) -> str:
    """What to do about a manifest by which nothing is ingested, of kinds that all episodes have."""
    cure = f"--ignore {' '.join(common)}" if common else "--ignore the kinds that are as they should be"
    return f"; nothing is left to ingest: {cure}, and write it again"


if __name__ == "__main__":
    main()
