"""Trains with features in bf16, as accelerators do, and with those of a CPU, in float32: are the losses alike?

``python -m benchmarks.number_formats RUN DATA`` (a finished run of ``tiny`` and its ``--data-dir``, both left alone)
trains ``tiny``'s tokenizer, ``tiny``, and ``roboscape_s`` with 4 blocks of width 128 for 100 steps each, with three
seeds, and prints the mean loss of the last 20 steps as a table. It is about rounding: on a CPU, bf16 features are slow.
"""

import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import tyro

from rsjax.config import AdamW, Config, RoboScapeConfig
from rsjax.models.base import create_autoencoder, create_model
from rsjax.models.load_run import load_config
from rsjax.runtime import tune_process
from rsjax.tools.commands.cli import main_errors, parse_options
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.stages import tokenizer_loader, world_model_loader
from rsjax.training.log import read_log
from rsjax.training.loop import fit

STEPS = 100
LAST = 20
SEEDS = (0, 1, 2)
DOORS = ("rsjax.models.roboscape.transformer.in_feature_dtype", "rsjax.tokenizers.magvit2.in_feature_dtype")


@dataclass(frozen=True)
class Options:
    """Compares the losses of trainings with features in bf16 and in float32."""

    run: tyro.conf.Positional[Path] = tyro.MISSING
    """A finished run of tiny."""
    data: tyro.conf.Positional[Path] = tyro.MISSING
    """Its directory of simulated data sets."""


def unchanged(config: Config) -> Config:
    """Returns the run's own configuration."""
    return config


def small_roboscape(config: Config) -> Config:
    """Returns the paper's objective and optimizer at the size of ``tiny``."""
    model = RoboScapeConfig(width=128, blocks=4, heads=4, compute_dtype="bfloat16")
    return replace(config, model=model, train=replace(config.train, optimizer=AdamW(learning_rate=1e-3), accumulate=1))


TRAININGS: dict[str, tuple[str, Callable[[Config], Config]]] = {
    "tokenizer of tiny": ("tokenizer", unchanged),
    "tiny": ("world_model", unchanged),
    "roboscape_s, 4 blocks of width 128": ("world_model", small_roboscape),
}


def last_loss(run: Run, part: str, seed: int, dtype: str) -> float:
    """Returns the mean loss of a training's last steps, with features between layers in this number format."""

    def in_this_dtype(_: str, network: Callable[[str], Any]) -> Any:
        return network(dtype)

    cfg = run.config
    create = {"tokenizer": create_autoencoder, "world_model": create_model}[part]
    loader = {"tokenizer": tokenizer_loader, "world_model": world_model_loader}[part](run)
    loop = replace(loader.loop, steps=STEPS, seed=seed, log_every=1, checkpoint_every=STEPS, eval_every=0)
    loader = replace(loader, loop=loop)
    with ExitStack() as stack:
        for door in DOORS:
            stack.enter_context(mock.patch(door, in_this_dtype))
        directory = stack.enter_context(tempfile.TemporaryDirectory())
        fit(create(cfg), loop, loader, Path(directory), name=f"{part} {dtype} {seed}")
        return float(np.mean([row["loss"] for row in read_log(Path(directory))[-LAST:]]))


@main_errors()
def main() -> None:
    """Prints the table."""
    tune_process()
    options = parse_options(sys.argv[1:], "python -m benchmarks.number_formats", Options.__doc__ or "", Options())
    config = load_config(options.run)
    lines = ["| loss | seed | float32 features | bf16 features | difference |", "|---|---|---|---|---|"]
    for name, (part, change) in TRAININGS.items():
        run = Run(change(config), options.run, options.data)
        losses = np.array([[last_loss(run, part, seed, dtype) for dtype in ("float32", "bfloat16")] for seed in SEEDS])
        for seed, (exact, half) in zip(SEEDS, losses, strict=True):
            lines.append(f"| {name} | {seed} | {exact:.4f} | {half:.4f} | {half - exact:+.4f} |")
        deviation = np.std(losses[:, 0], ddof=1)
        lines.append(f"| {name} | | deviation of seeds {deviation:.4f} | | mean {np.mean(losses @ [-1, 1]):+.4f} |")
    print(*lines, sep="\n")


if __name__ == "__main__":
    main()
