"""Layers of diffusion transformers: fixed positions, the time embedding, adaptive norms.

Axes: B clips, S cells, C width.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int

TIME_CHANNELS = 256
PERIOD = 10_000.0


def positions(count: int, width: int) -> Float32[np.ndarray, "count width"]:
    """Returns sines, then cosines, of the positions 0 … count - 1 at frequencies that fall from 1 to 1/10,000."""
    return _waves(np.arange(count), width).astype(np.float32)


def grid_positions(rows: int, columns: int, width: int, scale: float = 1.0) -> Float32[np.ndarray, "S width"]:
    """Returns sines and cosines of cells' positions ÷ ``scale``: columns in the first half of channels, then rows."""
    row, column = (x / scale for x in np.divmod(np.arange(rows * columns), columns))
    return np.concatenate([_waves(column, width // 2), _waves(row, width // 2)], axis=1).astype(np.float32)


def _waves(at: np.ndarray, width: int) -> np.ndarray:
    # Written as in the public code of IRASim and diffusers, so that rounding in float32 gives the same bits.
    angles = at[:, None] * (1.0 / PERIOD ** (np.arange(width // 2) / (width / 2.0)))
    return np.concatenate([np.sin(angles), np.cos(angles)], axis=1)


def time_waves(t: Int[Array, " B"], width: int = TIME_CHANNELS) -> Float[Array, "B width"]:
    """Returns cosines, then sines, of the step of the forward process."""
    half = width // 2
    angles = t[:, None].astype(jnp.float32) * jnp.exp(-np.log(PERIOD) * jnp.arange(half) / half)
    return jnp.concatenate([jnp.cos(angles), jnp.sin(angles)], axis=-1)


class TimeEmbedding(nn.Module):
    """An MLP on ``channels`` :func:`time_waves`."""

    width: int
    channels: int = TIME_CHANNELS

    @nn.compact
    def __call__(self, t: Int[Array, " B"]) -> Float[Array, "B C"]:
        small = nn.initializers.normal(0.02)
        x = nn.Dense(self.width, kernel_init=small, name="fc1")(time_waves(t, self.channels))
        return nn.Dense(self.width, kernel_init=small, name="fc2")(nn.silu(x))


def plain_norm(x: Float[Array, "*N C"], epsilon: float = 1e-6) -> Float[Array, "*N C"]:
    """Returns LayerNorm of x without scale and shift."""
    centred = x - jnp.mean(x, axis=-1, keepdims=True)
    return centred * jax.lax.rsqrt(jnp.mean(jnp.square(centred), axis=-1, keepdims=True) + epsilon)


def modulate(x: Float[Array, "*N C"], shift: Float[Array, "*N C"], scale: Float[Array, "*N C"]) -> Float[Array, "*N C"]:
    """Returns the normalised x with the condition's shift and scale: norm(x)·(1 + scale) + shift."""
    return plain_norm(x) * (1 + scale) + shift
