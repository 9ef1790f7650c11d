"""The interface between a model and the train step: parameters, batches and loss terms.

The tokenizer and every family of world models implement :class:`Trainable`.
"""

from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Array, Float, Int, Key

Scalar: TypeAlias = Float[Array, ""]
Term: TypeAlias = tuple[Scalar, Scalar]  # (weighted sum, weight); the term's value is their ratio over all devices
Params: TypeAlias = dict[str, Any]  # a tree of arrays
Extra: TypeAlias = dict[str, Any] | None  # a tree of arrays that is carried from step to step with the parameters

B = TypeVar("B", contravariant=True)


class StepContext(NamedTuple):
    """Inputs of a loss besides parameters, batch and key.

    Attributes:
        step: the number of steps before this one; -1 in validation, which is no step.
        extra: what the model carries from step to step.
        axis_name: pmap's axis over which the batch is split; None if XLA sees the whole batch.
    """

    step: Int[Array, ""]
    extra: Extra
    axis_name: str | None


class Trainable(Protocol[B]):
    """A model with its loss on batches of type ``B``: a frozen dataclass, so that jit takes it as a static argument.

    Subclasses inherit the defaults that a batch is a dict of arrays and that nothing is carried from step to step.
    """

    @property
    def loss_weights(self) -> dict[str, float]:
        """The weight λ of each loss term by name."""
        ...

    def __hash__(self) -> int:
        """Compiled programs are found again by this hash: that of the fields in a frozen dataclass."""
        return object.__hash__(self)

    def init(self, key: Key[Array, ""]) -> Params:
        """Returns fresh parameters."""
        ...

    def init_extra(self) -> Extra:
        """Returns the initial ``extra``; None if nothing is carried from step to step."""
        return None

    def batch(self, arrays: dict[str, np.ndarray]) -> Any:
        """Returns the batch for :meth:`loss_terms` from a loader's stacked arrays; by default the arrays themselves."""
        return arrays

    def loss_terms(self, params: Params, batch: B, key: Key[Array, ""], context: StepContext) -> dict[str, Term]:
        """Returns (weighted sum, weight) of each term of ``loss_weights`` on this device's part of a batch."""
        ...

    def next_extra(self, extra: Extra, means: dict[str, Scalar]) -> Extra:
        """Returns ``extra`` after a step, from the terms' means over all devices."""
        return extra
