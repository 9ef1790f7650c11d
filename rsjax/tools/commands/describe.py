"""Describes a preset: modules, parameters, operations, memory. ``rsjax describe roboscape_s``"""

import json
import shlex
import sys
from dataclasses import dataclass

from rsjax.tools.commands.cli import main_errors, parse

PROG = "rsjax describe"


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    json: bool = False
    """Print the numbers as one JSON object instead."""


@main_errors()
def main() -> None:
    """Prints the description."""
    about = "Counts parameters, operations and memory, from shapes. PRESET may be a run directory."
    config, options = parse(sys.argv[1:], PROG, about, Options(), runs=True)
    from rich.console import Console

    from rsjax.tools.describe import describe, render

    description = describe(config)
    if options.json:
        print(json.dumps({"preset": description.name} | description.figures, indent=1))
    else:
        Console().print(render(description))
        print(f"On accelerators: rsjax compile {shlex.quote(sys.argv[1])} --target h100x8")
