"""Some training clips see a learned null action instead of their own, so that sampling can be guided by actions.

This is classifier-free guidance (Ho and Salimans 2022, arXiv 2207.12598).

Axes: B clips, T frames, C width.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def dropped_actions(rate: float, key: Array, index: Int[Array, " B"]) -> Bool[Array, " B"] | None:
    """Draws the clips that see the null action, each with probability ``rate``; None if the rate is 0.

    Args:
        key: the step's key, the same on all devices.
        index: each clip's place in the global batch.
    """
    if not rate:
        return None
    key = jax.random.fold_in(key, 2)  # independent of the two keys that masking splits it into
    return jax.vmap(lambda place: jax.random.bernoulli(jax.random.fold_in(key, place), rate))(index)


def with_null_action(
    encoded: Float[Array, "B T C"], null: Float[Array, " C"], drop: Bool[Array, " B"] | None
) -> Float[Array, "B T C"]:
    """Returns the encoded actions, or the null action for the clips in ``drop``."""
    if drop is None:
        return encoded
    return jnp.where(drop[:, None, None], null, encoded)
