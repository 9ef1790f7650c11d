"""The keypoint term that predicts where tracked points go: a head on the RGB branch's features, for training alone.

L = D/n Σ_i Σ_t≥2 [v_i^t · H(m̂_t(p_i^{t-1}) - (p_i^t - p_i^{t-1})) + BCE(v̂_t(p_i^{t-1}), v_i^t)], over the K tracks
that move most and the n steps from a frame t-1 that shows the point. m̂_t and v̂_t are the head's outputs at frame t: the
displacement, in cells, and the logit of whether the point is visible in t. H is the Huber loss of both coordinates
(quadratic up to 1 cell), and v_i^t is 1 if the point is visible in t, else 0.

Frame t's features know the action that leads into t, frame t-1's do not; so the head reads those of frame t, at the
cell in which the point was in t-1. Points that were in one cell share a prediction. The labels are the tracks, which
the batch has anyway. D is the number of code bits: it brings the term to the scale of Eq. 5, so that one λ₂ suits both.

Axes: B clips, T frames, S cells, C width, K tracks.
"""

import flax.linen as nn
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from rsjax.layers.dense import Dense, layer_norm

OUTPUTS = 3  # x and y of the displacement, and the logit of visibility


class MotionHead(nn.Module):
    """A norm and one linear layer, so that the features themselves have to say how things move."""

    @nn.compact
    def __call__(self, features: Float[Array, "B T S C"]) -> Float[Array, "B T S 3"]:
        return Dense(OUTPUTS, name="out")(layer_norm("norm")(features))


def motion_error(
    predicted: Float[Array, "B T S 3"],
    points: Float[Array, "B T K 2"],
    visible: Bool[Array, "B T K"],
    cells: Int[Array, "B T K"],
) -> Float[Array, "B T-1 K"]:
    """Returns the error of each point's predicted step into every frame t ≥ 2, without D.

    Args:
        predicted: the head's outputs.
        points: the tracks, in units of cells.
        visible: the frames that show each point.
        cells: the points' cells.
    """
    there = jnp.take_along_axis(predicted[:, 1:], cells[:, :-1, :, None], axis=2)
    moved = points[:, 1:] - points[:, :-1]
    arrives = visible[:, 1:].astype(there.dtype)
    where = jnp.sum(optax.huber_loss(there[..., :2], moved), axis=-1)
    return arrives * where + optax.sigmoid_binary_cross_entropy(there[..., 2], arrives)
