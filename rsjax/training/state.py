"""The training state, the optimizer and the learning rate schedule."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.tree_util import KeyPath
from jaxtyping import Array, Int32

from rsjax.config import LoopConfig, OptimizerConfig
from rsjax.trainable import Extra, Params, Trainable


@struct.dataclass
class TrainState:
    """Everything that a step reads and writes. Checkpoints contain it and the position in the data."""

    step: Int32[Array, ""]
    params: Params
    opt_state: optax.OptState
    ema: Params | None  # averaged parameters, if loop.ema is on
    extra: Extra  # what else the model carries from step to step
    skipped: Int32[Array, ""]  # number of skipped steps, whose loss or gradient was not finite

    @property
    def weights(self) -> Params:
        """The parameters that later stages use: the averaged ones if they exist."""
        return self.params if self.ema is None else self.ema


DECAY_SHARE = 0.2  # the share of a run in which the schedule wsd decays


def learning_rate(loop: LoopConfig) -> optax.Schedule:
    """Returns the learning rate schedule with warm-up, which starts again at each of ``loop.restarts``."""
    begins = [0, *loop.restarts]
    ends = [*loop.restarts, loop.steps]
    stretches = [_schedule(loop.optimizer, max(end - begin, 1)) for begin, end in zip(begins, ends, strict=True)]
    return optax.join_schedules(stretches, list(loop.restarts))


def _schedule(opt: OptimizerConfig, steps: int) -> optax.Schedule:
    peak = opt.learning_rate
    low = opt.learning_rate * opt.final_share
    warmup = min(opt.warmup_steps, steps - 1)
    if opt.schedule == "cosine":
        return optax.warmup_cosine_decay_schedule(0.0, peak, warmup, max(steps, warmup + 1), low)
    if opt.schedule == "steps":
        drops = optax.piecewise_constant_schedule(peak, {round(share * steps): 0.1 for share in opt.drop_at})
        return lambda step: drops(step) * jnp.minimum(1.0, step / warmup if warmup else 1.0)
    rise = optax.linear_schedule(0.0, peak, warmup)
    fall = max(1, steps - warmup if opt.schedule == "linear" else round(DECAY_SHARE * steps))
    begin = max(warmup, steps - fall)
    fall = max(1, steps - begin)
    parts = [rise, optax.constant_schedule(peak), optax.linear_schedule(peak, low, fall)]
    return optax.join_schedules(parts, [warmup, begin])


def make_optimizer(loop: LoopConfig) -> optax.GradientTransformation:
    """Returns the optimizer: clipping by the global norm (if it is on), then AdamW or Muon."""
    opt = loop.optimizer
    if opt.kind == "muon":
        inner = optax.contrib.muon(
            learning_rate(loop),
            weight_decay=opt.weight_decay,
            adam_b1=opt.betas[0],
            adam_b2=opt.betas[1],
            adam_weight_decay=opt.weight_decay,
            muon_weight_dimension_numbers=_matrices,
            consistent_rms=0.2,
        )
    else:
        inner = optax.adamw(learning_rate(loop), *opt.betas, weight_decay=opt.weight_decay)
    return optax.chain(optax.clip_by_global_norm(opt.grad_clip) if opt.grad_clip else optax.identity(), inner)


def _matrices(params: Params) -> Params:
    """Marks for Muon the matrices inside blocks, (blocks, in, out), and of convolutions, (height, width, in, out).

    None for embeddings, heads, biases, norms, and a network's last convolution, which is its head.
    """

    def axes(path: KeyPath, value: jax.Array) -> optax.contrib.MuonDimensionNumbers | None:
        names = [getattr(key, "key", "") for key in path]
        if names[-1] == "kernel" and "blocks" in names:
            return optax.contrib.MuonDimensionNumbers(reduction_axis=1, output_axis=2)
        if names[-1] == "kernel" and value.ndim == 4 and "conv_out" not in names:
            return optax.contrib.MuonDimensionNumbers(reduction_axis=(0, 1, 2), output_axis=3)
        return None

    return jax.tree.map_with_path(axes, params)


def fresh_params(model: Trainable[Any], loop: LoopConfig) -> Params:
    """Returns the parameters of a network that starts from nothing."""
    params: Params = model.init(jax.random.key(loop.seed))
    return params


def create_state(model: Trainable[Any], loop: LoopConfig, initial: Params | None = None) -> TrainState:
    """Returns the state before the first step, which depends only on the configuration and the initial parameters.

    Args:
        initial: None: fresh parameters.
    """
    params = initial
    if params is None:
        params = fresh_params(model, loop)
    ema = jax.tree.map(jnp.copy, params) if loop.ema else None  # a copy: donated buffers must not be shared
    return TrainState(
        step=jnp.int32(0),
        params=params,
        opt_state=make_optimizer(loop).init(params),
        ema=ema,
        extra=model.init_extra(),
        skipped=jnp.int32(0),
    )
