"""The validation loss during training, with the same masks every time."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Int, UInt8

from rsjax.trainable import Params, StepContext, Term, Trainable
from rsjax.training.step import combine

DRAWS = 4  # random masks per clip
_SEED = 20_251  # of the masks; not a setting, so that runs can be compared

B = TypeVar("B")


@dataclass(frozen=True)
class Validation:
    """The scores of one validation.

    Attributes:
        metric: decides the best checkpoint; lower is better.
        scalars: for the log, by name.
        pictures: 0–255, by name; names are file names.
    """

    metric: float
    scalars: dict[str, float]
    pictures: dict[str, UInt8[np.ndarray, "H W 3"]] = field(default_factory=dict)


Validate = Callable[[int, Params], Validation]
"""Takes the step and the state's ``weights``, on the host or one device."""


def validation_loss(model: Trainable[B], params: Params, batches: Iterable[B]) -> dict[str, float]:
    """Returns the loss and its terms over all batches, each with ``DRAWS`` masks that are the same at every call.

    Weighted sums and weights are added before dividing, so the batch size changes only rounding.

    Args:
        model: a model that carries nothing from step to step.
        batches: with ``index`` the clip's number and ``weight`` 0 for padding.

    Returns:
        "loss" and each term, unweighted.

    Raises:
        ValueError: there are no batches.
    """
    sums: dict[str, np.ndarray] = {}
    for batch in batches:
        for draw in range(DRAWS):
            for name, term in _terms(model, params, batch, np.int32(draw)).items():
                sums[name] = sums.get(name, np.zeros(2)) + np.array(term, np.float64)
    if not sums:
        raise ValueError("there are no validation clips")
    loss, terms = combine({name: (value, weight) for name, (value, weight) in sums.items()}, model.loss_weights)
    return {"loss": float(loss)} | {name: float(term) for name, term in terms.items()}


@partial(jax.jit, static_argnums=0)
def _terms(model: Trainable[Any], params: Params, batch: Any, draw: Int[Array, ""]) -> dict[str, Term]:
    key = jax.random.fold_in(jax.random.key(_SEED), draw)
    before_any = jax.numpy.int32(-1)  # so that self-conditioning is off, and losses of different settings compare
    return model.loss_terms(params, batch, key, StepContext(before_any, None, None))
