"""The one train step, for the tokenizer and the world model, for one device and many."""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from rsjax.config import LoopConfig
from rsjax.objective import losses
from rsjax.train.objectives import Objective, Surroundings
from rsjax.train.state import TrainState, learning_rate, make_optimizer

Metrics = dict[str, Float[Array, ""]]


def train_step(
    objective: Objective, loop: LoopConfig, state: TrainState, batch: Any, axis_name: str | None = None
) -> tuple[TrainState, Metrics]:
    """One optimizer step; a pure function, the same under jit, pmap and jit over a sharded mesh.

    Args:
        objective: static; what is trained.
        loop: static; optimizer, averaging and seed.
        state: replicated where there are several devices.
        batch: this device's part.
        axis_name: of pmap, over which sums and weights are added (separately); None where XLA sees the whole batch.

    Returns:
        The new state, and float32 scalars: the objective, its terms, and the norms of gradient, parameters and update.
    """
    # Keys follow from the step alone, so a resumed run draws what an uninterrupted one would have drawn.
    key = jax.random.fold_in(jax.random.key(loop.seed + 1), state.step)
    total = (lambda x: jax.lax.psum(x, axis_name)) if axis_name else (lambda x: x)
    around = Surroundings(state.step, state.extra, axis_name)

    def share_of_loss(params: Any) -> tuple[Float[Array, ""], Metrics]:
        return losses.combine(objective.terms(params, batch, key, around), objective.weights, total)

    (loss, terms), grads = jax.value_and_grad(share_of_loss, has_aux=True)(state.params)
    grads, metrics = total(grads), total({"loss": loss, **terms})

    updates, opt_state = make_optimizer(loop).update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    ema = state.ema
    if ema is not None:
        # A young average would remember the initial weights: its decay grows with its age.
        decay = jnp.minimum(loop.ema, (1.0 + state.step) / (10.0 + state.step))
        ema = optax.incremental_update(params, ema, 1 - decay)
    extra = objective.next_extra(state.extra, metrics)
    metrics |= {
        "grad_norm": optax.global_norm(grads),
        "param_norm": optax.global_norm(params),
        "update_norm": optax.global_norm(updates),
        "learning_rate": jnp.float32(learning_rate(loop)(state.step)),
    }
    return TrainState(state.step + 1, params, opt_state, ema, extra), metrics
