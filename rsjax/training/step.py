"""The one train step, for the tokenizer and the world model, for one device and many."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from rsjax.config import LoopConfig
from rsjax.models.roboscape import losses
from rsjax.models.roboscape.losses import Term
from rsjax.training.objectives import Objective, Surroundings
from rsjax.training.state import TrainState, learning_rate, make_optimizer

Metrics = dict[str, Float[Array, ""]]


def train_step(
    objective: Objective, loop: LoopConfig, state: TrainState, batch: Any, axis_name: str | None = None
) -> tuple[TrainState, Metrics]:
    """One optimizer step; a pure function, the same under jit, pmap and jit over a sharded mesh.

    Where the loss or the gradient is not finite, the state stays as it was, but for ``step``, ``skipped`` and the place
    in the learning rate's schedule.

    Args:
        objective: static; what is trained.
        loop: static; optimizer, averaging, seed, and the parts that the batch is computed in.
        state: replicated where there are several devices.
        batch: this device's part.
        axis_name: of pmap, over which sums and weights are added (separately); None where XLA sees the whole batch.

    Returns:
        The new state, and float32 scalars: the objective, its terms, the norms of gradient, parameters and update, and
        how many steps were left out so far.
    """
    # Keys follow from the step alone, so a resumed run draws what an uninterrupted one would have drawn.
    key = jax.random.fold_in(jax.random.key(loop.seed + 1), state.step)
    total = (lambda x: jax.lax.psum(x, axis_name)) if axis_name else (lambda x: x)
    around = Surroundings(state.step, state.extra, axis_name)

    def terms(params: Any, part: Any) -> dict[str, Term]:
        return objective.terms(params, part, key, around)

    grads, metrics = _gradients(terms, objective.weights, total, state.params, batch, loop.accumulate)
    grads, metrics = total(grads), total(metrics)
    grad_norm = optax.global_norm(grads)
    sound = jnp.isfinite(metrics["loss"]) & jnp.isfinite(grad_norm)

    updates, opt_state = make_optimizer(loop).update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    ema = state.ema
    if ema is not None:
        # A young average would remember the initial weights: its decay grows with its age.
        decay = jnp.minimum(loop.ema, (1.0 + state.step) / (10.0 + state.step))
        ema = optax.incremental_update(params, ema, 1 - decay)
    new = (params, opt_state, ema, objective.next_extra(state.extra, metrics))
    old = (state.params, state.opt_state, state.ema, state.extra)
    params, opt_state, ema, extra = jax.tree.map(lambda new, old: jnp.where(sound, new, old), new, old)
    # A step that was left out counts in the schedule of the learning rate, or the stages' restarts would come late.
    opt_state = optax.tree_utils.tree_set(opt_state, _is_schedule, count=state.step + 1)
    skipped = state.skipped + ~sound
    metrics |= {
        "grad_norm": grad_norm,
        "param_norm": optax.global_norm(params),
        "update_norm": jnp.where(sound, optax.global_norm(updates), 0.0),
        "learning_rate": jnp.float32(learning_rate(loop)(state.step)),
        "skipped": skipped.astype(jnp.float32),
    }
    return TrainState(state.step + 1, params, opt_state, ema, extra, skipped), metrics


def _is_schedule(path: Any, value: Any) -> bool:
    return getattr(path[-1], "tuple_name", "") == "ScaleByScheduleState"


def _gradients(
    terms: Callable[[Any, Any], dict[str, Term]],
    weights: dict[str, float],
    total: Callable[[Any], Any],
    params: Any,
    batch: Any,
    parts: int,
) -> tuple[Any, Metrics]:
    """This device's share of the gradient, and of the objective and its terms.

    A batch in several parts gives the same, to rounding: every part is divided by the weights of the whole batch, which
    are found first (no network is run for them). Only what the tokenizer finds over a batch (its codes' entropy, the
    discriminator's normalisation, LeCAM's averages) is then a part's own.
    """

    def share(params: Any, part: Any, whole: dict[str, Float[Array, ""]] | None) -> tuple[Float[Array, ""], Metrics]:
        found = terms(params, part)
        if whole is not None:
            found = {name: (value, whole[name]) for name, (value, _) in found.items()}
        loss, shares = losses.combine(found, weights, total)
        return loss, {"loss": loss, **shares}

    gradient = jax.grad(share, has_aux=True)
    if parts == 1:
        return gradient(params, batch, None)
    # Every parts-th row, so that rows that lie on one device of a mesh stay there.
    cut = jax.tree.map(lambda x: x.reshape(-1, parts, *x.shape[1:]).swapaxes(0, 1), batch)
    of_parts = jax.lax.map(lambda part: {name: weight for name, (_, weight) in terms(params, part).items()}, cut)
    whole = jax.tree.map(lambda x: jnp.sum(x, axis=0), of_parts)

    def add(carry: Any, part: Any) -> tuple[Any, None]:
        return jax.tree.map(jnp.add, carry, gradient(params, part, whole)), None

    zeros = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype),
        jax.eval_shape(gradient, params, jax.tree.map(lambda x: x[0], cut), whole),
    )
    return jax.lax.scan(add, zeros, cut)[0]
