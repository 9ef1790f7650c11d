"""Checks a data set and prints each problem and its place. ``rsjax doctor rlds /data/bridge``"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rsjax.config import ConfigError
from rsjax.tools.commands.cli import main_errors, parse_options
from rsjax.tools.ingest.formats import FORMATS

PROG = "rsjax doctor"


@dataclass(frozen=True)
class Options:
    """Checks every episode of a data set of any format, or of a store of clips, and prints the findings.

    Exits with 0 if nothing is wrong, with 1 if something is, and with 2 if the data set cannot be listed.
    """

    what: tyro.conf.Positional[str] = tyro.MISSING
    """A store of clips, or a format: agibot, lerobot, robomimic, libero, rlds, bair, folder, npz, sim."""
    path: tyro.conf.Positional[Path | None] = None
    """Path of the data set of that format."""
    option: tuple[str, ...] = ()
    """The format's own settings, such as keys=bridge or split=train; lists as JSON."""
    frames: int = 5
    """Pictures of each camera to decode, spread evenly over the episode; 0: all."""
    gap: float = 1.5
    """Longest time allowed between two frames, relative to 1 / fps."""
    unusual: float = 20.0
    """Largest action, or step of the state, allowed relative to the usual one."""
    ignore: tuple[str, ...] = ()
    """Kinds of findings to leave out, such as no-task."""
    lines: int = 50
    """Number of findings to print; 0: all."""
    workers: int = 1
    """Number of processes; -1: one per core."""
    fix: Path | None = None
    """Write a list for rsjax ingest --selection to this file; it leaves out every episode with a finding."""


@main_errors()
def main() -> None:
    """Prints a line per finding and a table of the kinds of findings."""
    if len(sys.argv) < 2:
        raise ConfigError(
            f"name a store, or a source and its path, first; usage: {PROG} STORE, or {PROG} SOURCE PATH [--fix FILE]; "
            f"sources: {', '.join(FORMATS)}"
        )
    options = parse_options(sys.argv[1:], PROG, Options.__doc__ or "", Options())
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from rsjax.processes import count_workers
    from rsjax.tools.ingest.doctor import KINDS, Thresholds, diagnose, open_any, write_selection
    from rsjax.tools.ingest.options import source_options

    console = Console(highlight=False, markup=False, emoji=False, soft_wrap=True)
    source = open_any(options.what, options.path, **source_options(options.option))
    with console.status("checking episodes") as status:
        limits = Thresholds(options.frames, options.gap, options.unusual)
        show = lambda done: status.update(f"checking episodes: {done}")  # noqa: E731
        diagnosis = diagnose(source, limits, options.ignore, show, count_workers(options.workers))
    findings = diagnosis.findings
    most = options.lines or sys.maxsize
    for finding in findings[:most]:
        console.print(f"{finding.episode}: {finding.kind}: {finding.detail}")
    if len(findings) > most:
        console.print(f"… and {len(findings) - most} more; --lines 0 prints all")
    for name, notes in diagnosis.mended[: max(0, most - len(findings))]:
        console.print(f"{name}: mended: {notes}")
    if findings:
        table = Table("kind", "episodes", "meaning", box=SIMPLE_HEAD, pad_edge=False)
        for kind, count in diagnosis.counts().items():
            table.add_row(kind, str(count), KINDS[kind])
        console.print(table, soft_wrap=False)
    reasons = diagnosis.reasons()
    total = len(diagnosis.refs)
    bad = sum(name in reasons for name, _ in diagnosis.refs)
    for kind in diagnosis.usual():
        console.print(f"all are {kind!r}: if that is as it should be, --ignore {kind}")
    console.print(f"{total} episodes: {total - bad} without a finding, {bad} with")
    if diagnosis.mended:
        console.print(f"mended by the reader, which is not a finding: {len(diagnosis.mended)}")
    if options.fix is not None:
        about = f"{source.name} {options.path or options.what}"
        kept, out = write_selection(options.fix, about, diagnosis.refs, reasons)
        line = f"{options.fix}: keeps {kept}, leaves out {out}"
        if not kept:
            common = diagnosis.usual()
            cure = f"--ignore {' '.join(common)}" if common else "mend what is wrong"
            line = f"{line}; nothing is left to ingest: {cure}, and write it again"
        console.print(line)
    if findings:
        raise SystemExit(1)
