"""Eq. 7 as one normalised weight on the cross-entropy, in place of a second cross-entropy beside L_RGB.

L = -Σ w ⊙ s log p(ŝ) / n with w = A / Ā: A is the map of Eq. 6, Ā its mean over the n masked cells, so that w has the
mean 1 there. γ then only shifts the objective towards the cells of moving points. Printed Eq. 7 also makes the
cross-entropy of RGB two times and more as heavy as L_RGB, so that λ₁ and λ₂ weigh less than they say.

With ``loss.attention`` "contact", A marks the cells of points that something else moves: those that rest in the first
quarter of a clip and then leave their place, such as those of a grasped cube, while the arm moves from the start. The
tracks tell this; they do not tell where two things touch, and a batch has neither the gripper's opening nor objects.

Axes: B clips, T frames, H×W cells, N tracks.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rsjax.trainable import Term

# In cells: how far a point that rests may be from its place in the first frame, as a cube settles by 0.2 in it, and how
# far one that moves gets. Of 200 clips of Lift this marks points (4.8 of 256) in 99 % of those in which the cube is
# lifted and in 22 % of the others.
RESTS = 0.3
MOVES = 0.5


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


def moved_by_others(tracks: Float[Array, "B N T 2"], visible: Bool[Array, "B N T"], grid: int) -> Bool[Array, "B N T"]:
    """Returns the frames that show a point which rests in the first quarter of its clip and moves later."""
    away = grid * jnp.linalg.norm(tracks - tracks[:, :, :1], axis=-1)
    away = jnp.where(visible, away, 0.0)
    early = max(2, tracks.shape[2] // 4)
    rests = jnp.max(away[..., :early], axis=-1) < RESTS
    moves = jnp.max(away, axis=-1) > MOVES
    return visible & (visible[..., 0] & rests & moves)[..., None]
