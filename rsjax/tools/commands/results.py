"""Makes the tables of the pages on results from the files of results. ``rsjax results``"""

import sys
from dataclasses import dataclass
from pathlib import Path

from rsjax.config import require
from rsjax.errors import UserError
from rsjax.tools.commands.cli import main_errors, parse_options

PROG = "rsjax results"


@dataclass(frozen=True)
class Options:
    """Makes the tables of docs/results and of the README anew from the files in docs/results/data."""

    add: tuple[str, ...] = ()
    """First copy what a study has measured for these claims."""
    study: Path = Path("runs/paper")
    """The directory of rsjax paper that --add takes the claims from."""
    merge: bool = False
    """--add keeps the trainings in the file whose seeds the study lacks."""
    run: tuple[Path, ...] = ()
    """First write the scores of these finished runs, which differ in their seeds."""
    name: str = ""
    """The name of the file that --run writes; or --add, if it is not the claim's: table1-multitask."""
    check: bool = False
    """Change nothing; name each table that differs from its file, and exit with 2 if there is any."""


@main_errors()
def main() -> None:
    """Writes the pages, or checks them."""
    options = parse_options(sys.argv[1:], PROG, Options.__doc__ or "", Options())
    from rsjax.tools.studies import result_pages

    root = Path(__file__).resolve().parents[3]
    require((root / "docs" / "results").is_dir(), f"{PROG} writes pages of a checkout; run it in one")
    named = len(options.add) + bool(options.run)
    require(not options.name or named == 1, f"--name names one file, but --add and --run write {named}")
    require(not options.run or bool(options.name), "--run needs --name, the name of its file, such as tiny")
    require(not options.merge or bool(options.add), "--merge is for --add")
    for claim in options.add:
        print(result_pages.add_result(root, options.study, claim, options.name, merge=options.merge))
    if options.run:
        print(result_pages.add_runs(root, options.run, options.name))
    if options.check:
        differing = list(result_pages.differences(root))
        if differing:
            raise UserError("; ".join(differing) + f" ({PROG} makes them anew)")
    else:
        for page in result_pages.write_pages(root):
            print(page)
