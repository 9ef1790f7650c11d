"""Keypoints: motion magnitude, top-K, token cells, and the attention map (paper §2.3, Eq. 6).

Axes: B clips, N tracks (N₀ dense or K selected), T frames, H×W token cells.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int


@struct.dataclass
class Keypoints:
    """Selected tracks on the token grid."""

    cells: Int[Array, "B K T"]  # row·W + column of the nearest cell
    visible: Bool[Array, "B K T"]  # the frames in which the point counts


def motion_magnitude(tracks: Float[Array, "*B N T 2"], visible: Bool[Array, "*B N T"]) -> Float[Array, "*B N"]:
    """Returns M_i = Σ_t ‖p_i^{t+1} - p_i^t‖₂ over the steps where the point counts before and after."""
    # The norm's gradient at 0 is undefined, which is harmless: no gradient flows through tracks.
    steps = jnp.linalg.norm(tracks[..., 1:, :] - tracks[..., :-1, :], axis=-1)
    return jnp.sum(steps * (visible[..., 1:] & visible[..., :-1]), axis=-1)


def token_cells(tracks: Float[Array, "*B 2"], grid: int) -> Int[Array, "*B"]:
    """Returns the index (row·grid + column) of the nearest cell; points outside the image go to its edge."""
    column, row = (jnp.clip(jnp.floor(tracks[..., i] * grid), 0, grid - 1).astype(jnp.int32) for i in (0, 1))
    return row * grid + column


def select(tracks: Float[Array, "B N T 2"], visible: Bool[Array, "B N T"], count: int, grid: int) -> Keypoints:
    """Returns T_sample, the ``count`` tracks that move most, on the token grid.

    Args:
        visible: the frames in which each point counts.
    """
    _, chosen = jax.lax.top_k(motion_magnitude(tracks, visible), count)
    take = jax.vmap(lambda values, indices: values[indices])
    return Keypoints(token_cells(take(tracks, chosen), grid), take(visible, chosen))


def attention_map(keypoints: Keypoints, grid: int, gamma: float) -> Float[Array, "B T H W"]:
    """Returns the map of Eq. 6: γ in the cells that a selected track passes through while visible, 1 elsewhere."""
    b, _, t = keypoints.cells.shape
    cells = jnp.where(keypoints.visible, keypoints.cells, grid**2)  # hidden points go to a spare cell
    hit = jnp.zeros((b, t, grid**2 + 1), bool)
    hit = hit.at[jnp.arange(b)[:, None, None], jnp.arange(t)[None, None], cells].set(True)
    return jnp.where(hit[..., :-1], gamma, 1.0).reshape(b, t, grid, grid)
