"""Ingests a data set into a store of clips. ``rsjax ingest rlds /data/bridge --out data/bridge``"""

import sys
from pathlib import Path

from rsjax.config import ConfigError
from rsjax.tools.commands.cli import main_errors, parse_options
from rsjax.tools.ingest.formats import FORMATS
from rsjax.tools.ingest.options import RECIPES, IngestOptions, make_plan, make_runner, unfiltered

PROG = "rsjax ingest"
ABOUT = f"""Reads, annotates, cuts and packs episodes.

SOURCE is the format: {", ".join(FORMATS)}. PATH is the folder or file of the data set, as docs/formats.md describes for
each; for sim it is a store of clips."""


@main_errors()
def main() -> None:
    """Ingests the missing episodes, and prints the outcome for every episode."""
    argv = sys.argv[1:]
    wants_help = {"-h", "--help"} & {*argv}
    if not wants_help and (len(argv) < 2 or argv[0].startswith("-") or argv[1].startswith("-")):
        raise ConfigError(
            f"name a source and its path first; usage: {PROG} SOURCE PATH --out STORE; sources: {', '.join(FORMATS)}"
        )
    source = ""
    path = ""
    rest = argv  # --help ends the command, so that no source is needed
    if not wants_help:
        source, path, *rest = argv
    options = parse_options(rest, f"{PROG} SOURCE PATH", ABOUT, IngestOptions())
    if options.recipe:  # again, since options change the recipe's settings
        recipe = IngestOptions(recipe=options.recipe, windows=RECIPES[options.recipe])
        options = parse_options(rest, f"{PROG} SOURCE PATH", ABOUT, recipe)
    plan = make_plan(source, Path(path), options)
    runner = make_runner(options)

    from rsjax.progress import Progress, note
    from rsjax.tools.ingest.ingest import count_steps, ingest, is_up_to_date, list_episodes
    from rsjax.tools.ingest.summary import lines

    listed = list_episodes(plan)
    refs, _ = listed
    if not options.retry and is_up_to_date(plan, refs):
        note(f"{plan.out} is up to date: it was made from the same {len(refs)} episodes in the same way")
        return
    print(f"{len(refs)} episodes; steps of each: {', '.join(step.name for step in plan.steps)}, packing", flush=True)
    with Progress("ingest", count_steps(plan, refs), "steps", settle=2 * len(plan.steps)) as progress:
        summary = ingest(
            plan,
            runner,
            lambda done, total: progress.update(done),
            listed,
            keep_clips=options.keep_clips,
            retry=options.retry,
        )
    if summary is None:
        note("nothing is quarantined that could be tried again")
    else:
        print(*lines(summary), sep="\n")
        if missing := unfiltered(options.windows):
            hint = "; --recipe paper turns them on (§2.2)"
            if options.recipe:
                hint = ""
            print(f"filters   off: {missing}{hint}")
        if tables := summary.tables():
            print(f"what was left out, and why: {tables} in {plan.folder}")
    print(f"store: {plan.out}")
