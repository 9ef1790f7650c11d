"""Compares the cost of three compiled programs with the committed one: ``python -m scripts.compiled [--write]``.

The cost is counted from the programs for an H100 (:mod:`rsjax.tools.compile`), so it is the same on every machine. It
needs the compilers: ``.venv/accelerators/bin/python`` has them after ``make accelerators``. After a change that is
worth a higher cost, or that lowers one, commit what ``--write`` writes.
"""

import json
import sys
from pathlib import Path
from typing import Any

from rsjax.command import main_errors
from rsjax.files import write_json
from rsjax.tools.commands.cli import parse
from rsjax.tools.commands.compile import Options, enter_environment

COSTS = ("roofline_s", "bytes", "kernels")
TOLERANCE = 0.02
TABLE = Path(__file__).with_suffix(".json")

# Few blocks are enough, since blocks are compiled once and repeated.
PROGRAMS = {
    "training of roboscape_s": "roboscape_s --model.blocks 4 --train.batch-size 8",
    "training of genie_35m": "genie_35m --model.blocks 4 --train.batch-size 8",
    "a frame of roboscape_s": "roboscape_s --model.blocks 4 --part sample --clips 1",
}


@main_errors()
def main() -> None:
    """Prints the costs, and fails if one is too high; with ``--write``, writes them."""
    enter_environment("cuda")
    costs = {name: measure(name) for name in PROGRAMS}
    for name, cost in costs.items():
        print(
            f"{name:<26} {cost['roofline_s'] * 1e3:9.3f} ms {cost['bytes'] / 1e9:9.3f} GB {cost['kernels']:7} kernels"
        )
    if sys.argv[1:] == ["--write"]:
        write_json(TABLE, costs)
    elif worse := [line for name, cost in costs.items() for line in compare(name, cost)]:
        print(*worse, sep="\n", file=sys.stderr)
        raise SystemExit(1)


def measure(name: str) -> dict[str, float]:
    """Compiles a program of :data:`PROGRAMS` for one H100, and returns its :data:`COSTS`."""
    from rich.console import Console

    from rsjax.tools.compile.run import run
    from rsjax.tools.compile.targets import find

    config, options = parse(PROGRAMS[name].split(), "scripts.compiled", "", Options())
    numbers = run(config, find("h100"), options.part, options.clips, Console(quiet=True), find_largest=False)[0]
    return {cost: numbers[cost] for cost in COSTS}


def compare(name: str, cost: dict[str, float]) -> list[str]:
    """Returns a line for each cost that is more than :data:`TOLERANCE` above the committed one."""
    committed: dict[str, Any] = json.loads(TABLE.read_text())[name]
    return [
        f"{name}: {key} rose from {committed[key]:.6g} to {value:.6g}; see scripts/compiled.py"
        for key, value in cost.items()
        if value > committed[key] * (1 + TOLERANCE)
    ]


if __name__ == "__main__":
    main()
