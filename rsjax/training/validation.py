"""Looking at a model while it trains: the loss on clips that it does not see, the same question at every step."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Int, UInt8

from rsjax.models.roboscape.losses import Term, combine
from rsjax.training.objectives import Objective, Surroundings

DRAWS = 4  # maskings of each clip
_SEED = 20_251  # of the maskings; not a setting, so that runs can be compared


@dataclass(frozen=True)
class HeldOut:
    """What an evaluation between two steps found.

    Attributes:
        metric: what the best checkpoint is chosen by; lower is better.
        scalars: to be logged, by name.
        pictures: 0–255, by name; names are file names.
    """

    metric: float
    scalars: dict[str, float]
    pictures: dict[str, UInt8[np.ndarray, "H W 3"]] = field(default_factory=dict)


Evaluate = Callable[[int, Any], HeldOut]
"""Takes the step, and the weights that later stages would use (the state's ``weights``) on the host or one device."""


def held_out_loss(objective: Objective, params: Any, batches: Iterable[Any]) -> dict[str, float]:
    """The objective and its terms over all batches, each masked in ``DRAWS`` ways that are the same at every call.

    Weighted sums and weights are added up before anything is divided, so the size of the batches changes nothing but
    rounding.

    Args:
        objective: one that carries nothing from step to step.
        batches: of the objective, each clip with its own ``index`` whatever batch it is in, padding with weight 0.

    Returns:
        "loss" and each term, unweighted.

    Raises:
        ValueError: there are no batches.
    """
    sums: dict[str, np.ndarray] = {}
    for batch in batches:
        for draw in range(DRAWS):
            for name, term in _terms(objective, params, batch, np.int32(draw)).items():
                sums[name] = sums.get(name, np.zeros(2)) + np.array(term, np.float64)
    if not sums:
        raise ValueError("there are no held-out clips")
    loss, terms = combine({name: (value, weight) for name, (value, weight) in sums.items()}, objective.weights)
    return {"loss": float(loss)} | {name: float(term) for name, term in terms.items()}


@partial(jax.jit, static_argnums=0)
def _terms(objective: Objective, params: Any, batch: Any, draw: Int[Array, ""]) -> dict[str, Term]:
    key = jax.random.fold_in(jax.random.key(_SEED), draw)
    return objective.terms(params, batch, key, Surroundings(jax.numpy.int32(0), None, None))
