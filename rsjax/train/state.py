"""The training state and its optimizer."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Int32

from rsjax.config import LoopConfig
from rsjax.train.objectives import Objective


@struct.dataclass
class TrainState:
    """Everything that a step reads and writes; what a checkpoint holds, with the place in the data."""

    step: Int32[Array, ""]
    params: Any
    opt_state: Any
    ema: Any  # averaged parameters, or None
    extra: Any = None  # what else the objective carries from step to step, or None

    @property
    def weights(self) -> Any:
        """The parameters that later stages use: the averaged ones where they are kept."""
        return self.params if self.ema is None else self.ema


def learning_rate(loop: LoopConfig) -> optax.Schedule:
    """Linear warm-up, then a cosine to ``final_share`` of the peak at the last step, or falls to a tenth."""
    opt = loop.optimizer
    warmup = min(opt.warmup_steps, max(loop.steps - 1, 1))
    if opt.schedule == "steps":
        drops = optax.piecewise_constant_schedule(
            opt.learning_rate, {round(share * loop.steps): 0.1 for share in opt.drop_at}
        )
        return lambda step: drops(step) * jnp.minimum(1.0, step / warmup if warmup else 1.0)
    return optax.warmup_cosine_decay_schedule(
        0.0, opt.learning_rate, warmup, max(loop.steps, warmup + 1), opt.learning_rate * opt.final_share
    )


def make_optimizer(loop: LoopConfig) -> optax.GradientTransformation:
    """Clipping by the global norm (where it is on), then AdamW or Muon."""
    opt = loop.optimizer
    if opt.kind == "muon":
        inner = optax.contrib.muon(
            learning_rate(loop),
            weight_decay=opt.weight_decay,
            adam_b1=opt.beta1,
            adam_b2=opt.beta2,
            adam_weight_decay=opt.weight_decay,
            muon_weight_dimension_numbers=_block_matrices,
            consistent_rms=0.2,
        )
    else:
        inner = optax.adamw(learning_rate(loop), opt.beta1, opt.beta2, weight_decay=opt.weight_decay)
    return optax.chain(optax.clip_by_global_norm(opt.grad_clip) if opt.grad_clip else optax.identity(), inner)


def _block_matrices(params: Any) -> Any:
    """Which parameters are matrices inside blocks, (blocks, in, out); None for embeddings, heads, biases and norms."""

    def axes(path: Any, value: Any) -> optax.contrib.MuonDimensionNumbers | None:
        names = [key.key for key in path]
        matrix = "blocks" in names and names[-1] == "kernel"
        return optax.contrib.MuonDimensionNumbers(reduction_axis=1, output_axis=2) if matrix else None

    return jax.tree.map_with_path(axes, params)


def create_state(objective: Objective, loop: LoopConfig, start: Callable[[Any], Any] | None = None) -> TrainState:
    """The state before the first step; a function of the configuration alone.

    Args:
        start: fresh parameters to those that training begins with; the fresh ones if not given.
    """
    params = objective.init(jax.random.key(loop.seed))
    if start is not None:
        params = start(params)
    ema = jax.tree.map(jnp.copy, params) if loop.ema else None  # a copy: donated buffers must not be shared
    return TrainState(jnp.int32(0), params, make_optimizer(loop).init(params), ema, objective.init_extra())
