"""The train step of the tokenizer and the world model, on one device or many."""

from collections.abc import Callable
from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import optax

from rsjax.config import LoopConfig
from rsjax.trainable import Params, Scalar, StepContext, Term, Trainable, combine
from rsjax.training.state import TrainState, learning_rate, make_optimizer

Metrics: TypeAlias = dict[str, Scalar]
B = TypeVar("B")


def train_step(
    model: Trainable[B], loop: LoopConfig, state: TrainState, batch: B, axis_name: str | None = None
) -> tuple[TrainState, Metrics]:
    """Does one optimizer step. A pure function, the same under jit, pmap and jit over a sharded mesh.

    If the loss or the gradient is not finite, the step is skipped: of the state only ``step``, ``skipped`` and the
    position in the learning rate schedule change.

    Args:
        model: static; the model to train.
        loop: static; settings of the optimizer, averaging, seed and accumulation.
        state: replicated under pmap.
        batch: this device's part of the batch.
        axis_name: pmap's axis, over which sums and weights are added separately; None if XLA sees the whole batch.

    Returns:
        The new state, and float32 scalars: the loss, its terms, the norms of gradient, parameters and update, the
        learning rate, and the number of skipped steps so far.
    """
    # Keys depend only on the step, so a resumed run draws the same numbers as an uninterrupted one.
    key = jax.random.fold_in(jax.random.key(loop.seed + 1), state.step)
    total = (lambda x: jax.lax.psum(x, axis_name)) if axis_name else (lambda x: x)
    context = StepContext(state.step, state.extra, axis_name)

    def terms(params: Params, part: B) -> dict[str, Term]:
        return model.loss_terms(params, part, key, context)

    grads, metrics = _gradients(terms, model.loss_weights, total, state.params, batch, loop.accumulate)
    grads, metrics = total(grads), total(metrics)
    grad_norm = optax.global_norm(grads)
    finite = jnp.isfinite(metrics["loss"]) & jnp.isfinite(grad_norm)

    updates, opt_state = make_optimizer(loop).update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    ema = state.ema
    if ema is not None:
        # The decay grows with the average's age; otherwise a young average would consist of the initial weights.
        decay = jnp.minimum(loop.ema, (1.0 + state.step) / (10.0 + state.step))
        ema = optax.incremental_update(params, ema, 1 - decay)
    new = (params, opt_state, ema, model.next_extra(state.extra, metrics))
    old = (state.params, state.opt_state, state.ema, state.extra)
    params, opt_state, ema, extra = jax.tree.map(lambda new, old: jnp.where(finite, new, old), new, old)
    # The learning rate schedule counts skipped steps; otherwise its restarts would come late.
    opt_state = optax.tree_utils.tree_set(opt_state, _is_schedule, count=state.step + 1)
    skipped = state.skipped + ~finite
    metrics |= {
        "grad_norm": grad_norm,
        "param_norm": optax.global_norm(params),
        "update_norm": jnp.where(finite, optax.global_norm(updates), 0.0),
        "learning_rate": jnp.float32(learning_rate(loop)(state.step)),
        "skipped": skipped.astype(jnp.float32),
    }
    return TrainState(state.step + 1, params, opt_state, ema, extra, skipped), metrics


def as_numbers(metrics: Metrics) -> dict[str, float]:
    """Returns a step's metrics as numbers, after waiting for the step."""
    return {name: float(value) for name, value in jax.device_get(metrics).items()}


def _is_schedule(path: tuple[object, ...], value: object) -> bool:
    return getattr(path[-1], "tuple_name", "") == "ScaleByScheduleState"


def _gradients(
    terms: Callable[[Params, B], dict[str, Term]],
    weights: dict[str, float],
    total: Callable[[Scalar], Scalar],
    params: Params,
    batch: B,
    parts: int,
) -> tuple[Params, Metrics]:
    """Returns this device's share of the gradient, and of the loss and its terms.

    Splitting a batch into parts changes only rounding: each part is divided by the weights of the whole batch, which
    are computed first (XLA removes the network from that computation). Exceptions are the tokenizer's batch statistics,
    which are computed for each part: its codes' entropy, the discriminator's batch norm, LeCAM's averages.
    """

    def share(params: Params, part: B, whole: dict[str, Scalar] | None) -> tuple[Scalar, Metrics]:
        values = terms(params, part)
        if whole is not None:
            values = {name: (value, whole[name]) for name, (value, _) in values.items()}
        loss, shares = combine(values, weights, total)
        return loss, {"loss": loss, **shares}

    gradient = jax.grad(share, has_aux=True)
    if parts == 1:
        return gradient(params, batch, None)
    # A part takes every parts-th row, so that rows stay on their device of a mesh.
    stacked = jax.tree.map(lambda x: x.reshape(-1, parts, *x.shape[1:]).swapaxes(0, 1), batch)
    of_parts = jax.lax.map(lambda part: {name: weight for name, (_, weight) in terms(params, part).items()}, stacked)
    whole = jax.tree.map(lambda x: jnp.sum(x, axis=0), of_parts)

    def add(carry: tuple[Params, Metrics], part: B) -> tuple[tuple[Params, Metrics], None]:
        return jax.tree.map(jnp.add, carry, gradient(params, part, whole)), None

    zeros = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype),
        jax.eval_shape(gradient, params, jax.tree.map(lambda x: x[0], stacked), whole),
    )
    return jax.lax.scan(add, zeros, stacked)[0]
