"""Replays a skipped training step to find the clips whose loss or gradient is not finite."""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from rsjax.errors import UserError
from rsjax.models.base import create_autoencoder, create_model
from rsjax.tools.pipeline.run import Run
from rsjax.tools.pipeline.stages import pretrained_start, tokenizer_loader, world_model_loader
from rsjax.trainable import Params, StepContext, Trainable
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.log import SKIPPED, read_skipped
from rsjax.training.sharding import Sharding
from rsjax.training.step import combine


@dataclass(frozen=True)
class ReplayedClip:
    """One clip of a replayed batch.

    Attributes:
        source: the clip's file, record and origin, from :meth:`rsjax.data.loader.Loader.identify`.
        scalars: the clip's loss, the terms of the loss, and the norm of its gradient.
    """

    source: dict[str, Any]
    scalars: dict[str, float]

    @property
    def finite(self) -> bool:
        return all(map(np.isfinite, self.scalars.values()))


def replay(run: Run, stage: Literal["tokenizer", "world_model"], step: int) -> Iterator[ReplayedClip]:
    """Yields the clips of a skipped step's batch, scored one by one with the random draws of that step.

    The parameters are those of the newest checkpoint, at that step or near it; without one, the initial parameters.

    Raises:
        UserError: the step was not skipped, or its data or the checkpoints are missing.
    """
    rows = {row["step"]: row for row in read_skipped(run.directory / stage)}
    if step not in rows:
        skipped = ", ".join(map(str, rows)) or "none"
        raise UserError(f"{run.directory / stage / SKIPPED}: step {step} was not skipped (skipped: {skipped})")
    model: Any
    if stage == "tokenizer":
        model = create_autoencoder(run.config)
        loader = tokenizer_loader(run)
    else:
        model = create_model(run.config)
        loader = world_model_loader(run)
    loop = replace(loader.loop, sharding="jit", fsdp=1)
    sharding = Sharding.create(loop)
    with closing(Checkpoints(run.directory / stage / "checkpoints", read_only=True)) as checkpoints:
        if checkpoints.latest() is None and not (run.directory / stage / "weights").exists():
            state = sharding.init(model, loop, pretrained_start(model, loop.start_from, stage))
        else:
            state, _ = checkpoints.restore(sharding.template(model, loop))
    sources = rows[step]["records"]
    batch = model.batch(loader.replay(rows[step]["data"]))
    clips = jax.tree.map(lambda x: x.reshape(len(sources), -1, *x.shape[1:]), batch)
    key = jax.random.fold_in(jax.random.key(loop.seed + 1), step - 1)
    for number, source in enumerate(sources):
        part = jax.tree.map(itemgetter(number), clips)
        context = StepContext(jnp.int32(step - 1), state.extra, None)
        scalars = _measure(model, state.params, part, key, context)
        yield ReplayedClip(source, {name: float(value) for name, value in scalars.items()})


@partial(jax.jit, static_argnums=0)
def _measure(model: Trainable[Any], params: Params, batch: Any, key: Array, context: StepContext) -> dict[str, Array]:
    def loss(params: Params) -> tuple[Array, dict[str, Array]]:
        total, terms = combine(model.loss_terms(params, batch, key, context), model.loss_weights)
        return total, {"loss": total, **terms}

    grads, scalars = jax.grad(loss, has_aux=True)(params)
    return scalars | {"grad_norm": optax.global_norm(grads)}


def skipped_steps(run: Run, stage: str) -> list[str]:
    """Returns a line for each skipped step."""
    return [
        f"step {row['step']}: loss {row['loss']}, gradient {row['grad_norm']}, {len(row['records'])} clips"
        for row in read_skipped(run.directory / stage)
    ]
