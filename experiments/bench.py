"""Measures a preset's speed. ``python -m experiments.bench roboscape_s --batch 1 --json bench.json``"""

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from experiments.cli import main_errors, parse
from rsjax.files import write_json
from rsjax.runtime import tune_process

PROG = "python -m experiments.bench"


@dataclass(frozen=True)
class Options:
    """Options of this command."""

    batch: int = 1
    """Clips per training step, rollout and loader batch; the part "feed" uses the preset's batch size."""
    only: str = ""
    """Parts, separated by commas: matmul,train,roofline,sample,tokenizer,environment,loader,feed; default: all."""
    horizons: tuple[int, ...] = ()
    """Lengths of rollouts in frames, including one prompt frame; default: the clips' length and three times that."""
    torch: bool = False
    """Also measure the model in plain PyTorch (needs make extras; for RoboScape only the RGB branch)."""
    json: Path | None = None
    """Write the numbers to this file; it is updated after each part."""


@main_errors()
def main() -> None:
    """Runs the benchmark, writes the file after each part, and prints a table."""
    tune_process()
    config, options = parse(sys.argv[1:], PROG, "Times training, sampling, tokenizer and loader.", Options())
    import jax
    from rich.console import Console

    from rsjax.tools.bench.run import PARTS, bench, table

    jax.config.update("jax_enable_compilation_cache", False)  # so that compilation itself is measured
    console = Console()
    only = tuple(options.only.split(",")) if options.only else PARTS
    keep = partial(write_json, options.json) if options.json else lambda numbers: None
    numbers = bench(config, options.batch, only, options.horizons, options.torch, say=console.print, keep=keep)
    console.print(table(numbers))


if __name__ == "__main__":
    main()
