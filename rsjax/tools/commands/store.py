"""Merges, splits and tokenizes stores. ``rsjax store merge OUT A B``, ``… split A``"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, arg

from rsjax.config import ConfigError
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options, with_first_screen

PROG = "rsjax store"
USAGE = (
    f"usage: {PROG} merge OUT STORE STORE …, or {PROG} split STORE --into FOLDER [--by difficulty | --parts 4], "
    f"or {PROG} tokenize STORE --run runs/tiny"
)


@dataclass(frozen=True)
class Merge:
    """Options of ``merge``."""

    out: Annotated[Positional[Path], arg(metavar="OUT")] = tyro.MISSING
    """Directory of the new store."""
    stores: Annotated[Positional[tuple[Path, ...]], arg(metavar="STORE STORE …")] = ()
    """Two stores or more."""


@dataclass(frozen=True)
class Split:
    """Options of ``split``."""

    store: Annotated[Positional[Path], arg(metavar="STORE")] = tyro.MISSING
    """A store of clips or of tokens."""
    into: Path = Path("parts")
    """Folder for the new stores."""
    by: str = "difficulty"
    """Column of the labels (task, difficulty, scene, segment, skill); each word in it becomes a store."""
    parts: int = 0
    """Split into this many stores of equal size instead."""


@dataclass(frozen=True)
class Tokenize:
    """Options of ``tokenize``."""

    store: Annotated[Positional[Path], arg(metavar="STORE")] = tyro.MISSING
    """A store of clips."""
    run: Path = Path("runs/tiny")
    """Run directory with the tokenizer."""


@main_errors()
def main() -> None:
    """Runs one of the actions and prints the stores that it made."""
    word, *argv = sys.argv[1:] or [""]
    if word in ("-h", "--help"):
        print(with_first_screen(USAGE, PROG, ""))
        return
    if word not in ACTIONS:
        raise ConfigError(USAGE)
    options, description, action = ACTIONS[word]
    for store in action(parse_options(argv, f"{PROG} {word}", description, options)):
        print(f"{store.path.absolute()}: {', '.join(f'{name} {count}' for name, count in store.counts().items())}")


def merge(options: Merge) -> list[Any]:
    """Merges the stores, and returns the new store."""
    from rsjax.data.merge import merge

    return [merge(options.stores, options.out)]


def split(options: Split) -> list[Any]:
    """Splits the store, and returns the parts."""
    from rsjax.data.merge import by_label, into_parts, split

    if options.parts < 0:
        raise ConfigError(f"--parts is {options.parts}; it is how many stores to make")
    if options.parts:
        parts = into_parts(options.store, options.parts, options.into)
    else:
        parts = by_label(options.store, options.by, options.into)
    return list(split(options.store, parts).values())


def tokenize(options: Tokenize) -> list[Any]:
    """Makes the store of tokens next to the clips, and returns it."""
    tune_process()
    from rsjax.data.store import open_store
    from rsjax.models.load_run import load_config
    from rsjax.tools.pipeline.prepared import prepare_store

    config = load_config(options.run)
    clips = open_store(options.store)
    prepared = prepare_store(options.run, config, clips)
    if prepared is clips:
        raise ConfigError(f"{options.run}: a model of family {config.model.family!r} has no tokens")
    return [prepared]


ACTIONS: dict[str, tuple[Any, str, Callable[[Any], list[Any]]]] = {
    "merge": (Merge(), "Merges stores into one.", merge),
    "split": (Split(), "Splits a store into several.", split),
    "tokenize": (Tokenize(), "Tokenizes every clip of a store; the tokens are kept beside the clips.", tokenize),
}
