"""How fast a preset runs here. ``python -m experiments.bench roboscape_s --batch 1 --json bench.json``"""

import json
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from experiments.cli import main_errors, parse
from rsjax.runtime import tune_process

PROG = "python -m experiments.bench"


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    batch: int = 1
    """Clips in a training step, a rollout and a loader's batch; feed trains with the preset's own."""
    only: str = ""
    """Parts to measure, with commas between them: matmul,train,sample,tokenizer,loader,feed; all if not
    given."""
    horizons: tuple[int, ...] = ()
    """Frames of the rollouts, their one prompt frame included; the model's own number and three times that if not
    given."""
    torch: bool = False
    """Time a plain PyTorch program of the RGB branch too, in the same run (needs rsjax[torch])."""
    json: Path | None = None
    """Write the numbers to this file too, after each part all so far."""


@main_errors()
def main() -> None:
    """Measures, writes the file after each part, and prints a table."""
    tune_process()
    config, options = parse(sys.argv[1:], PROG, "Times training, sampling, tokenizer and loader.", Options())
    import jax
    from rich.console import Console

    from rsjax.bench.run import PARTS, bench, table

    jax.config.update("jax_enable_compilation_cache", False)  # compile times are those from nothing
    console = Console()
    only = tuple(options.only.split(",")) if options.only else PARTS
    keep = partial(write, options.json) if options.json else lambda numbers: None
    numbers = bench(config, options.batch, only, options.horizons, options.torch, say=console.print, keep=keep)
    console.print(table(numbers))


def write(path: Path, numbers: dict[str, Any]) -> None:
    """Puts the numbers into the file, in place of what it held."""
    from rsjax.files import disk_guard, write_atomically

    with disk_guard(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, f"{json.dumps(numbers, indent=1)}\n".encode())


if __name__ == "__main__":
    main()
