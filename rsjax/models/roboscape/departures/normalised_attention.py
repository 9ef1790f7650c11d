"""Eq. 7 as one normalised weight on the cross-entropy, in place of a second cross-entropy beside L_RGB.

L = -Σ w ⊙ s log p(ŝ) / n with w = A / Ā: A is the map of Eq. 6, Ā its mean over the n masked cells, so that w has the
mean 1 there. γ then only shifts the objective towards the cells of moving points. Printed Eq. 7 also makes the
cross-entropy of RGB two times and more as heavy as L_RGB, so that λ₁ and λ₂ weigh less than they say.

The weight could also be spent on cells of contact, but a batch has neither the gripper's opening nor the objects.

Axes: B clips, T frames, H×W cells.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax.trainable import Term


def normalised(
    nats: Float[Array, "B T H W"], attention: Float[Array, "B T H W"], masked: Float[Array, "B T H W"]
) -> Term:
    """Returns the weighted sum Σ A·nats and its weight Σ A over the masked cells, whose ratio is L.

    Args:
        nats: each cell's cross-entropy.
        attention: A.
        masked: 1 for the masked cells that count, 0 for others.
    """
    weights = attention * masked
    return jnp.sum(nats * weights), jnp.sum(weights)
