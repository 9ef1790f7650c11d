"""A depth branch at coarser cells than RGB's (``model.depth.cells``), which costs a part of the paper's branch.

Depth is smooth, so few cells may say enough of it. A coarse cell covers n × n token cells, which are joined before the
branch and taken apart after it.

Axes: B clips, T frames, S cells, s = S / n² coarse cells, C channels.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float


def merged(x: Float[Array, "B T S C"], n: int) -> Float[Array, "B T s C2"]:
    """Returns the coarse cells' channels: those of their n² cells, row by row, one after another."""
    b, t, cells, width = x.shape
    side = math.isqrt(cells) // n
    x = x.reshape(b, t, side, n, side, n, width).swapaxes(3, 4)
    return x.reshape(b, t, side**2, n**2 * width)


def split(x: Float[Array, "B T s C2"], n: int) -> Float[Array, "B T S C"]:
    """Returns each cell's part of its coarse cell's channels; the inverse of :func:`merged`."""
    b, t, cells, width = x.shape
    side = math.isqrt(cells)
    x = x.reshape(b, t, side, side, n, n, width // n**2).swapaxes(3, 4)
    return x.reshape(b, t, cells * n**2, width // n**2)


def spread(x: Float[Array, "B T s C"], n: int) -> Float[Array, "B T S C"]:
    """Returns for each cell the channels of its coarse cell."""
    return split(jnp.concatenate([x] * n**2, axis=-1), n)
