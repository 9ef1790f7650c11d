"""Copies saved models to and from a hub. ``rsjax hub push mine USER/NAME``, ``… pull USER/NAME mine``"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, arg

from rsjax.config import ConfigError
from rsjax.tools.commands.cli import main_errors, parse_options, with_first_screen

PROG = "rsjax hub"
USAGE = f"usage: {PROG} push MODEL USER/NAME, or {PROG} pull USER/NAME MODEL"


@dataclass(frozen=True)
class Push:
    """Options of ``push``."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")] = tyro.MISSING
    """A saved model, made by rsjax save."""
    repository: Annotated[Positional[str], arg(metavar="USER/NAME")] = tyro.MISSING
    """The repository, which is made if it is missing."""
    private: bool = False
    """Make it private."""


@dataclass(frozen=True)
class Pull:
    """Options of ``pull``."""

    repository: Annotated[Positional[str], arg(metavar="USER/NAME")] = tyro.MISSING
    """The repository."""
    model: Annotated[Positional[Path], arg(metavar="MODEL")] = tyro.MISSING
    """The new directory; a saved model that is there is replaced."""
    revision: str | None = None
    """A branch, tag or commit; default: the newest."""


@main_errors()
def main() -> None:
    """Copies one model, and prints where it is."""
    word, *argv = sys.argv[1:] or [""]
    if word in ("-h", "--help"):
        print(with_first_screen(USAGE, PROG, ""))
        return
    if word not in ACTIONS:
        raise ConfigError(USAGE)
    options, description, action = ACTIONS[word]
    print(action(parse_options(argv, f"{PROG} {word}", description, options)))


def push_model(options: Push) -> str:
    """Uploads, and returns the address of the commit."""
    from rsjax.tools.hub import push

    return push(options.model, options.repository, options.private)


def pull_model(options: Pull) -> str:
    """Downloads, and returns the directory with what to do next."""
    from rsjax.tools.hub import pull

    pull(options.repository, options.model, options.revision)
    return f"{options.model.absolute()}; next: rsjax play {options.model}"


ACTIONS: dict[str, tuple[Any, str, Callable[[Any], str]]] = {
    "push": (Push(), "Uploads a saved model to a hub, as it is.", push_model),
    "pull": (Pull(), "Downloads a saved model from a hub, and checks it.", pull_model),
}
