"""Stores into one, one into several, or into tokens. ``python -m experiments.store merge OUT A B``, ``… split A``"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.cli import main_errors, parse_options
from rsjax.config import ConfigError
from rsjax.runtime import tune_process

PROG = "python -m experiments.store"
USAGE = (
    f"usage: {PROG} merge OUT STORE STORE …, or {PROG} split STORE --into FOLDER [--by difficulty | --parts 4], "
    f"or {PROG} tokenize STORE --run runs/tiny"
)


@dataclass(frozen=True)
class Split:
    """Options of ``split``."""

    into: Path = Path("parts")
    """A folder, in which the new stores are made; parts, where you are, if not given."""
    by: str = "difficulty"
    """A column of the labels (task, difficulty, scene, segment, skill): a store for each of its words."""
    parts: int = 0
    """So many stores of as many records each, instead."""


@dataclass(frozen=True)
class Tokenize:
    """Options of ``tokenize``."""

    run: Path = Path("runs/tiny")
    """A run directory, whose tokenizer makes the tokens of every clip; they lie beside the clips."""


@main_errors()
def main() -> None:
    """Does one of them, and says what was made."""
    argv = sys.argv[1:]
    if len(argv) < 2 and {"-h", "--help"} & {*argv}:
        print(USAGE)
        return
    what, places = (argv[0] if argv else ""), [Path(word) for word in argv[1:]]
    if what == "merge" and len(places) >= 3:
        from rsjax.data.merge import merge

        made = [merge(places[1:], places[0])]
    elif what == "split" and places:
        rest = argv[1:] if places[0].name.startswith("-") else argv[2:]
        made = split_store(places[0], parse_options(rest, f"{PROG} split STORE", "One store into several.", Split()))
    elif what == "tokenize" and places:
        tune_process()
        rest = argv[1:] if places[0].name.startswith("-") else argv[2:]
        options = parse_options(rest, f"{PROG} tokenize STORE", "Tokens of every clip, beside the clips.", Tokenize())
        made = [tokenize(places[0], options.run)]
    else:
        raise ConfigError(USAGE)
    for store in made:
        sizes = ", ".join(f"{name} {len(store.source(name))}" for name in store.splits)
        print(f"{store.path.absolute()}: {sizes}")


def split_store(place: Path, options: Split) -> list[Any]:
    """The parts."""
    from rsjax.data.merge import by_label, into_parts, split

    if options.parts < 0:
        raise ConfigError(f"--parts is {options.parts}; it is how many stores to make")
    even, into = options.parts, options.into
    return list(split(place, into_parts(place, even, into) if even else by_label(place, options.by, into)).values())


def tokenize(place: Path, run: Path) -> Any:
    """The store of tokens."""
    from rsjax.data.store import open_store
    from rsjax.pipeline.generator import load_config, load_tokenizer
    from rsjax.pipeline.tokens import tokenize_store

    clips, config = open_store(place), load_config(run)
    return open_store(tokenize_store(clips, config, load_tokenizer(config, run), place / "tokens"))


if __name__ == "__main__":
    main()
