"""The keypoint term that compares how a point's code changes from frame to frame with how it truly changes.

L = 1/n Σ_i Σ_t≥2 ‖(ŝ_t(p_i^t) - ŝ_{t-1}(p_i^{t-1})) - (s_t(p_i^t) - s_{t-1}(p_i^{t-1}))‖², with the mean codes ŝ and
the true codes s, over the K tracks that move most and the n steps in which a point is visible before and after. K = N₀
makes the points dense.

The true codes are its minimum. They are not that of Eq. 5, which asks for a code that does not change while the point
moves: codes of a tokenizer do change. An error that is the same in all frames of a track costs nothing here; the
cross-entropy and, with ``observed_anchor``, the true first frame rule it out.

Axes: B clips, T frames, S cells, D code bits, K tracks.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def difference(
    s_hat: Float[Array, "B T S D"], s: Float[Array, "B T S D"], cells: Int[Array, "B T K"]
) -> Float[Array, "B T-1 K"]:
    """Returns the squared error of each point's change of code from every frame to the next.

    Args:
        s_hat: ŝ, the mean codes under the predicted probabilities.
        s: the true codes.
        cells: the points' cells.
    """
    errors = jnp.take_along_axis(s_hat - s, cells[..., None], axis=2)
    return jnp.sum(jnp.square(errors[:, 1:] - errors[:, :-1]), axis=-1)
