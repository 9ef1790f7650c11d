"""The keypoint term that compares the RGB branch's features along a track instead of the codes of Eq. 5.

L = 2D/n Σ_i Σ_t≥2 (1 - cos(f_t(p_i^t), sg f_1(p_i^1))), over the K tracks of Eq. 5 and their n frames that show the
point: ‖·‖² as in Eq. 5, of vectors that have the length √D of a code of D bits.

f are the features that RGB's head reads, minus their mean over the frame's cells: the frame's position and its action,
which are added to all cells alike, drop out. Neither features of 0 nor features that are the same in all cells are a
minimum, since their cosine is 0.

The teacher, from which no gradient flows (sg), is the network itself in the same pass: the first frame is never masked
and sees no other frame, so its features depend on no prediction, and they cost nothing. They are those of the true
first frame only if ``model.corruption`` is off; otherwise some of its tokens are random, as in every frame.
Averaged weights as teacher would need a second pass, and most presets average none.

Axes: B clips, T frames, S cells, C width, K keypoints.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

EPSILON = 1e-6


def feature_distance(features: Float[Array, "B T S C"], cells: Int[Array, "B T K"]) -> Float[Array, "B T-1 K"]:
    """Returns 2·(1 - cos(f_t(p_i^t), sg f_1(p_i^1))) of each keypoint in every frame t ≥ 2, without D.

    Args:
        features: of the RGB branch.
        cells: the keypoints' cells.
    """
    centred = features - jnp.mean(features, axis=2, keepdims=True)
    f = centred * jax.lax.rsqrt(jnp.sum(jnp.square(centred), axis=-1, keepdims=True) + EPSILON)
    along = jnp.take_along_axis(f, cells[..., None], axis=2)
    teacher = jax.lax.stop_gradient(along[:, :1])
    return 2 - 2 * jnp.sum(along[:, 1:] * teacher, axis=-1)
