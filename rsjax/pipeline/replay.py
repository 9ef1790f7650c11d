"""A step that was left out, once more: which of its clips has a loss or a gradient that is not finite."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from rsjax.errors import UserError
from rsjax.models.roboscape import losses
from rsjax.pipeline.jobs import Job, tokenizer_job, world_model_job
from rsjax.pipeline.run import Run
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.objectives import Objective, Surroundings
from rsjax.training.placement import Placement
from rsjax.training.skipped import NAME, read_skipped
from rsjax.training.state import TrainState


@dataclass(frozen=True)
class Clip:
    """One clip of a replayed batch.

    Attributes:
        source: where it lies and comes from, as :meth:`rsjax.data.loader.Loader.identify` tells it.
        scalars: its own loss, the loss's terms, and the norm of its gradient.
    """

    source: dict[str, Any]
    scalars: dict[str, float]

    @property
    def finite(self) -> bool:
        return all(map(np.isfinite, self.scalars.values()))


def replay(run: Run, stage: Literal["tokenizer", "world_model"], step: int) -> Iterator[Clip]:
    """The clips of a step's batch one by one, with the random draws of that step.

    The parameters are those of the newest checkpoint: the ones of that step, or of a step near it.

    Raises:
        UserError: no such step was left out, or its data or the checkpoints are gone.
    """
    rows = {row["step"]: row for row in read_skipped(run.directory / stage)}
    if step not in rows:
        there = ", ".join(map(str, rows)) or "none"
        raise UserError(f"{run.directory / stage / NAME}: step {step} was not left out (left out: {there})")
    job: Job[Any] = tokenizer_job(run) if stage == "tokenizer" else world_model_job(run)
    state, sources = _newest(job), rows[step]["records"]
    batch = job.to_batch(job.feed.replay(rows[step]["data"]))
    key = jax.random.fold_in(jax.random.key(job.loop.seed + 1), step - 1)
    for number, source in enumerate(sources):
        part = jax.tree.map(partial(_rows, number, len(sources)), batch)
        scalars = _measure(job.objective, state.params, part, key, Surroundings(jnp.int32(step - 1), state.extra, None))
        yield Clip(source, {name: float(value) for name, value in scalars.items()})


def _newest(job: Job[Any]) -> TrainState:
    loop = replace(job.loop, placement="jit", fsdp=1)
    checkpoints = Checkpoints(job.directory / "checkpoints", read_only=True)
    try:
        if checkpoints.latest() is None:
            return Placement.create(loop).init(job.objective, loop, job.start)
        return checkpoints.restore(Placement.create(loop).template(job.objective, loop))[0]
    finally:
        checkpoints.close()


def _rows(number: int, clips: int, x: Array) -> Array:
    size = len(x) // clips
    return x[number * size : (number + 1) * size]


@partial(jax.jit, static_argnums=0)
def _measure(objective: Objective, params: Any, batch: Any, key: Array, around: Any) -> dict[str, Array]:
    def loss(params: Any) -> tuple[Array, dict[str, Array]]:
        total, terms = losses.combine(objective.terms(params, batch, key, around), objective.weights)
        return total, {"loss": total, **terms}

    grads, scalars = jax.grad(loss, has_aux=True)(params)
    return scalars | {"grad_norm": optax.global_norm(grads)}


def skipped_steps(run: Run, stage: str) -> list[str]:
    """A line for each step that was left out."""
    return [
        f"step {row['step']}: loss {row['loss']}, gradient {row['grad_norm']}, {len(row['records'])} clips"
        for row in read_skipped(Path(run.directory) / stage)
    ]
