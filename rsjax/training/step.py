"""The train step of the tokenizer and the world model, on one device or many."""

from typing import TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Key

from rsjax.config import LoopConfig
from rsjax.layers.partition import gathered
from rsjax.trainable import Params, Scalar, StepContext, Term, Trainable
from rsjax.training.state import TrainState, learning_rate, make_optimizer

Metrics: TypeAlias = dict[str, Scalar]
B = TypeVar("B")
Tree = TypeVar("Tree")


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
    context = StepContext(state.step, state.extra, axis_name)
    if loop.accumulate == 1:
        grads, metrics = jax.grad(loss_share, has_aux=True)(state.params, model, batch, key, context)
    else:
        grads, metrics = accumulated_gradient(state.params, model, batch, key, context, loop.accumulate)
    grads = over_devices(grads, axis_name)
    metrics = over_devices(metrics, axis_name)
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


def loss_share(
    params: Params,
    model: Trainable[B],
    batch: B,
    key: Key[Array, ""],
    context: StepContext,
    weights: dict[str, Scalar] | None = None,
) -> tuple[Scalar, Metrics]:
    """Returns this device's share of the loss, and of the loss and its terms (paper Eq. 8).

    Args:
        weights: the terms' weights over the whole batch, if ``batch`` is a part of it.
    """
    # Blocks gather their own parameters (rsjax.layers.partition), one after another.
    params = {name: part if name == "blocks" else gathered(part) for name, part in params.items()}
    terms = model.loss_terms(params, batch, key, context)
    if weights is not None:
        terms = {name: (value, weights[name]) for name, (value, _) in terms.items()}
    loss, shares = combine(terms, model.loss_weights, context.axis_name)
    return loss, {"loss": loss, **shares}


def combine(
    terms: dict[str, Term], weights: dict[str, float], axis_name: str | None = None
) -> tuple[Scalar, dict[str, Scalar]]:
    """Returns this device's share of the loss, the sum of λ·sum/weight over the terms (paper Eq. 8).

    Sums and weights are added over devices separately, since the mean of per-device ratios is not the global ratio.

    Args:
        terms: by name; the names must equal those of ``weights``, so that no term is misspelt or forgotten.
        weights: λ by name.
        axis_name: pmap's axis over which the batch is split; None if XLA sees the whole batch.

    Returns:
        This device's share of the loss (the shares of all devices add up to the loss), and each term's share without λ.

    Raises:
        KeyError: terms and weights have different names.
    """
    if terms.keys() != weights.keys():
        raise KeyError(f"loss terms {sorted(terms)} are not the configured weights {sorted(weights)}")
    shares = {}
    loss = jnp.float32(0)
    for name, (value, weight) in terms.items():
        whole = over_devices(jax.lax.stop_gradient(weight), axis_name)
        shares[name] = value / jnp.maximum(whole, 1e-8)
        loss += weights[name] * shares[name]
    return loss, shares


def over_devices(tree: Tree, axis_name: str | None) -> Tree:
    """Adds each array over pmap's axis; without one, XLA already sees the whole batch."""
    return tree if axis_name is None else jax.lax.psum(tree, axis_name)


def accumulated_gradient(
    params: Params, model: Trainable[B], batch: B, key: Key[Array, ""], context: StepContext, parts: int
) -> tuple[Params, Metrics]:
    """Returns the gradient of :func:`loss_share`, and the loss and its terms, computed for one part after another.

    Splitting a batch into parts changes only rounding: each part is divided by the weights of the whole batch, which
    are computed first (XLA removes the network from that computation). Exceptions are the tokenizer's batch statistics,
    which are computed for each part: its codes' entropy, the discriminator's batch norm, LeCAM's averages.
    """
    gradient = jax.grad(loss_share, has_aux=True)
    # A part takes every parts-th row, so that rows stay on their device of a mesh.
    stacked = jax.tree.map(lambda x: x.reshape(-1, parts, *x.shape[1:]).swapaxes(0, 1), batch)

    def weights_of(part: B) -> dict[str, Scalar]:
        return {name: weight for name, (_, weight) in model.loss_terms(params, part, key, context).items()}

    weights = jax.tree.map(lambda x: jnp.sum(x, axis=0), jax.lax.map(weights_of, stacked))

    def add(carry: tuple[Params, Metrics], part: B) -> tuple[tuple[Params, Metrics], None]:
        return jax.tree.map(jnp.add, carry, gradient(params, model, part, key, context, weights)), None

    first = jax.tree.map(lambda x: x[0], stacked)
    shapes = jax.eval_shape(lambda: gradient(params, model, first, key, context, weights))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return jax.lax.scan(add, zeros, stacked)[0]


def as_numbers(metrics: Metrics) -> dict[str, float]:
    """Returns a step's metrics as numbers, after waiting for the step."""
    return {name: float(value) for name, value in jax.device_get(metrics).items()}


def _is_schedule(path: tuple[object, ...], value: object) -> bool:
    return getattr(path[-1], "tuple_name", "") == "ScaleByScheduleState"
