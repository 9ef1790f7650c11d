"""Shows the contents of a store of clips or tokens. ``rsjax inspect STORE``"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from rsjax.config import ConfigError
from rsjax.config.fields import require_range
from rsjax.tools.commands.cli import main_errors, parse_options

PROG = "rsjax inspect"


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    store: Annotated[Positional[Path], arg(metavar="STORE")] = tyro.MISSING
    """A store of clips or of tokens."""
    records: int = 200
    """How many records to read, spread evenly; counts, tasks and difficulties cover all records."""
    sheet: Path | None = None
    """File for the sheet of pictures, .png, .jpg, .webp or .html. Default: STORE-sheet.png next to the store, or .html
    if no font of this machine has all letters of the captions."""
    clips: int = 12
    """How many clips to show on the sheet and in the viewer."""
    rerun: bool = False
    """Open the clips with RGB, depth and tracks in the Rerun viewer (pip install 'rsjax[rerun]')."""
    rerun_file: Path | None = None
    """Write the clips to this file instead; `rerun FILE` opens it."""

    def __post_init__(self) -> None:
        require_range(self, "inspect", 1, math.inf, "records", "clips")


@main_errors()
def main() -> None:
    """Prints the contents and writes a sheet of pictures."""
    options = parse_options(sys.argv[1:], PROG, "Shows counts, shapes, histograms and a sheet of pictures.", Options())
    place = options.store
    if options.sheet and options.sheet.suffix.lower() not in (".png", ".jpg", ".webp", ".html"):
        raise ConfigError(f"--sheet is {options.sheet}; name a .png, .jpg, .webp or .html file")
    from PIL import Image

    from rsjax.data.store import open_store
    from rsjax.files import disk_guard, write_file
    from rsjax.tools.studies.report.contents import describe
    from rsjax.tools.studies.report.lettering import lacks_letters
    from rsjax.tools.studies.report.rerun_view import rerun_view
    from rsjax.tools.studies.report.sheet import sheet_page, sheet_picture, sheet_rows

    store = open_store(place)
    lines, damaged = describe(store, options.records)
    print(f"store     {place.absolute()} ({store.manifest.get('kind')})", *lines, sep="\n")
    if store.manifest.get("kind") == "clips":
        rows = list(sheet_rows(store, options.clips))
        unwritable = any(lacks_letters(caption) for caption, _ in rows)
        name = f"{place.absolute().name}-sheet.{'html' if unwritable else 'png'}"
        sheet = (options.sheet or place.absolute().with_name(name)).absolute()
        with disk_guard(sheet):
            if sheet.suffix.lower() == ".html":
                write_file(sheet, sheet_page(rows, place.absolute().name).encode())
            else:
                Image.fromarray(sheet_picture(rows)).save(sheet)
                if unwritable:
                    print("letters   no font here has all letters of the captions; --sheet NAME.html shows them")
        print(f"sheet: {sheet}")
    if options.rerun or options.rerun_file:
        for message in rerun_view(store, options.clips, options.rerun_file):
            print(f"left out: {message}")
    if options.rerun_file:
        print(f"viewer file: {options.rerun_file.absolute()}")
    if damaged:
        raise SystemExit(1)
