"""Measures a preset's speed. ``rsjax bench roboscape_s --batch 1 --json bench.json``"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsjax.config import Config
from rsjax.errors import UserError
from rsjax.files import write_json
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse

PROG = "rsjax bench"


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
    """Also measure the model in plain PyTorch (needs a checkout and make extras; for RoboScape only the RGB branch)."""
    json: Path | None = None
    """Write the numbers to this file; it is updated after each part."""


@main_errors()
def main() -> None:
    """Runs the benchmark, writes the file after each part, and prints a table."""
    tune_process()
    config, options = parse(sys.argv[1:], PROG, "Times training, sampling, tokenizer and loader.", Options())
    import jax
    from rich.console import Console

    from rsjax.tools.bench.run import PARTS, bench, terminal_table

    jax.config.update("jax_enable_compilation_cache", False)  # so that compilation itself is measured
    rival = None
    if options.torch:
        rival = pytorch_rival(config)
    parts: tuple[str, ...] = PARTS
    if options.only:
        parts = tuple(options.only.split(","))
    console = Console()

    def keep(numbers: dict[str, Any]) -> None:
        if options.json:
            write_json(options.json, numbers)

    numbers = bench(config, options.batch, parts, options.horizons, rival, say=console.print, keep=keep)
    console.print(terminal_table(numbers))


def pytorch_rival(config: Config) -> Callable[..., dict[str, Any]]:
    """Returns the function that measures a family's network in PyTorch.

    Raises:
        UserError: the folder ``benchmarks`` or a package is missing, or PyTorch has no network like this one.
    """
    if not (Path(__file__).parents[3] / "benchmarks" / "pytorch").is_dir():
        raise UserError("--torch needs the folder benchmarks/ of a checkout of rsjax; run there, or leave --torch out")
    from benchmarks.pytorch.baselines import check_torch, torch_baseline

    check_torch(config)
    return torch_baseline
