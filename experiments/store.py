"""Stores into one, or one into several. ``python -m experiments.store merge OUT A B`` or ``… split STORE``"""

import sys
from dataclasses import dataclass
from pathlib import Path

from experiments.cli import main_errors, parse_options
from rsjax.config import ConfigError

PROG = "python -m experiments.store"
USAGE = f"usage: {PROG} merge OUT STORE STORE …, or {PROG} split STORE --into FOLDER [--by difficulty | --parts 4]"


@dataclass(frozen=True)
class Options:
    """Options of ``split``."""

    into: Path = Path("parts")
    """A folder, in which the new stores are made."""
    by: str = "difficulty"
    """A column of the labels (task, difficulty, scene): a store for each of its words."""
    parts: int = 0
    """So many stores of as many records each, instead."""


@main_errors()
def main() -> None:
    """Merges or splits, and says what was made."""
    words = [word for word in sys.argv[1:] if not word.startswith("-")]
    what, places = (words[0] if words else ""), [Path(word) for word in words[1:]]
    if {"-h", "--help"} & {*sys.argv[1:]}:
        print(USAGE)
        return
    from rsjax.data.merge import by_label, into_parts, merge, split

    if what == "merge" and len(places) >= 3:
        made = [merge(places[1:], places[0])]
    elif what == "split" and places:
        rest = sys.argv[sys.argv.index(str(words[1])) + 1 :]
        options = parse_options(rest, f"{PROG} split STORE", "One store into several.", Options())
        parts = into_parts(options.parts, options.into) if options.parts else None
        made = list(split(places[0], parts or by_label(places[0], options.by, options.into)).values())
    else:
        raise ConfigError(USAGE)
    for store in made:
        sizes = ", ".join(f"{name} {len(store.source(name))}" for name in store.splits)
        print(f"{store.path.absolute()}: {sizes}")


if __name__ == "__main__":
    main()
