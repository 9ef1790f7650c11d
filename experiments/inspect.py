"""What is in a store of clips or tokens. ``python -m experiments.inspect STORE``"""

import sys
from dataclasses import dataclass
from pathlib import Path

from experiments.cli import main_errors, parse_options
from rsjax.config import ConfigError

PROG = "python -m experiments.inspect"


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    records: int = 200
    """How many records are read, spread evenly; counts, tasks and difficulties are of all."""
    sheet: Path | None = None
    """Where the sheet of pictures is written; STORE-sheet.png beside the store if not given."""
    clips: int = 12
    """Of the sheet, and of the viewer."""
    rerun: bool = False
    """Open clips with RGB, depth and tracks in the Rerun viewer (pip install 'rsjax[rerun]')."""


@main_errors()
def main() -> None:
    """Prints, and writes a sheet of pictures."""
    argv = sys.argv[1:]
    if not argv or (argv[0].startswith("-") and not {"-h", "--help"} & {*argv}):
        raise ConfigError(f"name a store first; usage: {PROG} STORE [--sheet FILE] [--rerun]")
    place, argv = (None, argv) if argv[0].startswith("-") else (Path(argv[0]), argv[1:])
    options = parse_options(argv, f"{PROG} STORE", "Counts, shapes, histograms, and a sheet of pictures.", Options())
    assert place is not None
    from PIL import Image

    from rsjax.data.guard import open_foreign
    from rsjax.data.inspect import contact_sheet, look, render, rerun_view

    store = open_foreign(place)
    contents = look(store, options.records)
    print(*[f"store     {place.absolute()} ({store.manifest.get('kind')})", *render(contents)], sep="\n")
    if store.manifest.get("kind") == "clips":
        sheet = options.sheet or place.absolute().with_name(f"{place.absolute().name}-sheet.png")
        Image.fromarray(contact_sheet(store, options.clips)).save(sheet)
        print(f"sheet: {sheet.absolute()}")
    if options.rerun:
        rerun_view(store, options.clips)
    if contents.damaged:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
