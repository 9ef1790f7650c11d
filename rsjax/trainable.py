"""The interface between a model and the train step: parameters, and loss terms that :func:`combine` sums.

The tokenizer and every family of world models implement :class:`Trainable`.
"""

from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

Scalar: TypeAlias = Float[Array, ""]
Term: TypeAlias = tuple[Scalar, Scalar]  # (weighted sum, weight); the term's value is their ratio over all devices
Params: TypeAlias = dict[str, Any]  # a tree of arrays
Extra: TypeAlias = dict[str, Any] | None  # a tree of arrays that is carried from step to step with the parameters

B = TypeVar("B", contravariant=True)
Tree = TypeVar("Tree")


class StepContext(NamedTuple):
    """Inputs of a loss besides parameters, batch and key.

    Attributes:
        step: the number of steps before this one.
        extra: what the model carries from step to step.
        axis_name: pmap's axis over which the batch is split; None if XLA sees the whole batch.
    """

    step: Int[Array, ""]
    extra: Extra
    axis_name: str | None


class Trainable(Protocol[B]):
    """A model with its loss on batches of type ``B``: a frozen dataclass, so that jit takes it as a static argument.

    Subclasses inherit the default that nothing is carried from step to step.
    """

    @property
    def loss_weights(self) -> dict[str, float]:
        """The weight λ of each loss term by name."""
        ...

    def init(self, key: Key[Array, ""]) -> Params:
        """Returns fresh parameters."""
        ...

    def init_extra(self) -> Extra:
        """Returns the initial ``extra``; None if nothing is carried from step to step."""
        return None

    def loss_terms(self, params: Params, batch: B, key: Key[Array, ""], context: StepContext) -> dict[str, Term]:
        """Returns (weighted sum, weight) of each term of ``loss_weights`` on this device's part of a batch."""
        ...

    def next_extra(self, extra: Extra, means: dict[str, Scalar]) -> Extra:
        """Returns ``extra`` after a step, from the terms' means over all devices."""
        return extra


def over_devices(tree: Tree, axis_name: str | None) -> Tree:
    """Adds each array over pmap's axis; without one, XLA already sees the whole batch."""
    return tree if axis_name is None else jax.lax.psum(tree, axis_name)


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
