"""How fast a preset runs here. ``python -m experiments.bench roboscape_s --batch 1 --json bench.json``"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path

from experiments.cli import main_errors, parse
from rsjax.runtime import tune_process

PROG = "python -m experiments.bench"


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    batch: int | None = None
    """Clips in a training step and a rollout; the preset's batch size if not given."""
    only: str = ""
    """Parts to measure, with commas between them: matmul,train,sample,tokenizer,loader; all if not given."""
    horizons: tuple[int, ...] = ()
    """Frames of the rollouts, prompt included; the model's own number and three times that if not given."""
    torch: bool = False
    """Time a plain PyTorch program of the RGB branch too, in the same run (needs rsjax[torch])."""
    json: Path | None = None
    """Write the numbers to this file too."""


@main_errors()
def main() -> None:
    """Measures, prints a table and writes the file."""
    tune_process()
    config, options = parse(sys.argv[1:], PROG, "Times training, sampling, tokenizer and loader.", Options())
    import jax
    from rich.console import Console

    from rsjax.bench.run import PARTS, bench, table
    from rsjax.data.store import disk_guard, write_atomically

    jax.config.update("jax_enable_compilation_cache", False)  # compile times are those from nothing
    console = Console()
    only = tuple(options.only.split(",")) if options.only else PARTS
    batch = config.train.batch_size if options.batch is None else options.batch
    numbers = bench(config, batch, only, options.horizons, options.torch, say=console.print)
    console.print(table(numbers))
    if options.json:
        with disk_guard(options.json):
            options.json.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(options.json, f"{json.dumps(numbers, indent=1)}\n".encode())


if __name__ == "__main__":
    main()
