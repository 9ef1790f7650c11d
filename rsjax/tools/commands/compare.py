"""Compares evaluated runs. ``rsjax compare full=runs/a0,runs/a1 genie=runs/g0,runs/g1``"""

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from rsjax.config import ConfigError
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options

PROG = "rsjax compare"


@dataclass(frozen=True)
class Options:
    """Compares evaluations: means over seeds, paired intervals, tests, published numbers, film strips."""

    groups: Annotated[Positional[tuple[str, ...]], arg(metavar="RUN|NAME=RUN,RUN …")] = ()
    """Run directories, or groups of runs that differ only in their seed; a pattern such as 'a=runs/a/*' is a group."""
    protocol: str | None = None
    """The evaluation to compare: paper, run (of the evaluation stage), … Default: the one that all runs have."""
    against: str = ""
    """The group that the others are compared with; default: the first."""
    only: tuple[str, ...] = ()
    """Metrics to compare, by key or pattern ('psnr*' 'depth_*'); default: those of tables."""
    out: Path | None = None
    """Directory of compare.md, .csv, .json and .html; default: runs/compare-NAME-NAME…"""


@main_errors()
def main() -> None:
    """Writes the four files and prints the tables."""
    tune_process()
    options = parse_options(sys.argv[1:], PROG, Options.__doc__ or "", Options())
    if not options.groups:
        raise ConfigError(f"name run directories; usage: {PROG} RUN RUN, or NAME=RUN,RUN … (see {PROG} --help)")
    from rsjax.files import safe_id, write_file, write_json
    from rsjax.tools.studies.compare.groups import read_groups
    from rsjax.tools.studies.compare.page import write_page
    from rsjax.tools.studies.compare.table import as_csv, as_json, as_markdown, compare

    comparison = compare(read_groups(options.groups, options.protocol), options.only, options.against)
    names = safe_id("-".join(group.name for group in comparison.groups))
    out = options.out or Path("runs") / f"compare-{names}"
    write_file(out / "compare.md", as_markdown(comparison).encode())
    write_file(out / "compare.csv", as_csv(comparison).encode())
    write_json(out / "compare.json", as_json(comparison))
    write_page(out / "compare.html", comparison, shlex.join([*PROG.split(), *sys.argv[1:]]))
    print(as_markdown(comparison))
    print(f"page: {(out / 'compare.html').absolute()} (and .md, .csv, .json)")
