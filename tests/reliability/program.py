"""A stage that trains, small and slow enough to be disturbed: ``python -m tests.reliability.program FOLDER STORE …``.

It leaves what a stage of the main job leaves: a mark, checkpoints, a log and the final weights.
"""

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from rsjax.config import AdamW, LoopConfig
from rsjax.data.loader import Arrays, batches
from rsjax.data.quarantine import NAME as QUARANTINE
from rsjax.data.store import open_store, write_store
from rsjax.files import write_atomically
from rsjax.tools.commands.cli import main_errors
from rsjax.trainable import StepContext, Term
from rsjax.training.checkpoint import save_weights
from tests.training import toy


@dataclass(frozen=True)
class Heavy(toy.Regression):
    """A regression whose checkpoints take a moment to write, and whose loss is not a number at some steps.

    Attributes:
        poisoned: steps done before those.
    """

    poisoned: tuple[int, ...] = ()

    @property
    def loss_weights(self) -> dict[str, float]:
        return super().loss_weights | {"weight": 1.0}

    def init(self, key: Any) -> Any:
        return super().init(key) | {"ballast": jax.random.normal(key, (200_000,))}

    def batch(self, arrays: Arrays) -> Arrays:
        time.sleep(0.02)
        return {"x": arrays["x"], "y": arrays["y"]}

    def loss_terms(self, params: Any, batch: Any, key: Any, context: StepContext) -> dict[str, Term]:
        poisoned = jnp.isin(context.step, jnp.array(self.poisoned or (-1,)))
        ballast = jnp.sum(jnp.square(params["ballast"]))
        weight = (jnp.where(poisoned, jnp.nan, ballast), jnp.float32(params["ballast"].size))
        return super().loss_terms(params, batch, key, context) | {"weight": weight}


def make_store(path: Path) -> None:
    """Twenty records."""
    write_store(path, "toy", {"train": iter(toy.records(20))}, {"key": "toy"})


@main_errors()
def main() -> None:
    """Trains until it is finished."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("store", type=Path)
    parser.add_argument("--poisoned", type=int, nargs="*", default=())
    options = parser.parse_args()

    loop = LoopConfig(
        steps=60,
        batch_size=2,
        optimizer=AdamW(learning_rate=1e-2, warmup_steps=2),
        ema=0.9,
        log_every=1,
        checkpoint_every=10,
        skip_budget=10,
        sharding="jit",
    )
    source = open_store(options.store).source("train")
    mark(options.folder, False)
    state = toy.train(
        loop,
        options.folder,
        model=Heavy(poisoned=tuple(options.poisoned)),
        loader=lambda data: batches(
            source, toy.jitter, loop.batch_size, seed=3, state=data, quarantine=options.folder / QUARANTINE
        ),
    )
    save_weights(options.folder / "weights", state.weights)
    mark(options.folder, True)


def mark(folder: Path, finished: bool) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "made.json", json.dumps({"finished": finished}).encode())


if __name__ == "__main__":
    main()
