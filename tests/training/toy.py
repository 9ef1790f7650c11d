"""A linear regression with noise drawn from the step's key: what a training loop has to get right, in no time."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rsjax.config import LoopConfig
from rsjax.data.loader import Arrays, Loader, batches
from rsjax.trainable import StepContext, Term, Trainable
from rsjax.training.loop import fit
from rsjax.training.state import TrainState

QUICK = {"xla_backend_optimization_level": 0}  # options of the compiler, for programs that run once


@dataclass(frozen=True)
class Regression(Trainable[Any]):
    """Predicts y from x, both noisy.

    Attributes:
        inputs: how many numbers of x it reads.
        to_batch: changes the loader's arrays; it has no part in the compiled step.
    """

    inputs: int = 3
    to_batch: Callable[[Arrays], Arrays] = field(default=dict, compare=False)

    @property
    def loss_weights(self) -> dict[str, float]:
        return {"error": 2.0}

    def init(self, key: Array) -> Any:
        return {"w": jax.random.normal(key, (self.inputs,)), "b": jnp.zeros(())}

    def batch(self, arrays: Arrays) -> Arrays:
        return self.to_batch(arrays)

    def loss_terms(self, params: Any, batch: Any, key: Array, context: StepContext) -> dict[str, Term]:
        noise = 0.1 * jax.random.normal(key)
        error = batch["x"][:, : self.inputs] @ params["w"] + params["b"] + noise - batch["y"]
        return {"error": (jnp.sum(jnp.square(error)), jnp.float32(error.size))}


def records(count: int = 7) -> list[dict[str, np.ndarray]]:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(count, 3)).astype(np.float32)
    return [{"x": row, "y": np.asarray(row @ [1.0, -2.0, 0.5], np.float32)} for row in x]


def jitter(record: dict[str, np.ndarray], rng: np.random.Generator) -> dict[str, np.ndarray]:
    return record | {"x": record["x"] + rng.normal(scale=0.01, size=3).astype(np.float32)}


def loader(state: dict[str, Any] | None, source: list[dict[str, np.ndarray]] | None = None) -> Loader:
    return batches(records() if source is None else source, jitter, 2, seed=3, state=state)


def train(loop: LoopConfig, directory: Path, **options: Any) -> TrainState:
    """:func:`rsjax.training.loop.fit` of the regression; ``options`` replace its arguments."""
    usual: dict[str, Any] = {"model": Regression(), "loader": loader, "name": "toy"}
    return fit(loop=loop, directory=directory, **(usual | options))
