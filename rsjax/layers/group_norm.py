"""Group normalisation (Wu & He 2018, arXiv 1803.08494) whose sums run along whole rows of channels.

flax's layer adds up each group's channels first, which CPUs cannot vectorise if groups are small: for large images it
takes 2 to 3 times as long (notebooks/cpu-performance.md). Parameters have the same names and shapes.

Axes: B images or sequences, C channels, G groups.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax.layers.parameters import parameter


class GroupNorm(nn.Module):
    """Normalises groups of neighbouring channels to mean 0 and variance 1, then scales and shifts each channel.

    It computes in float32; its output has the number format of its input.

    The variance is E[(x - E[x])²]: E[x²] - E[x]² is too inexact for parity with public weights.

    Attributes:
        groups: the number of groups, which must divide the channels.
        affine: whether there are "scale" and "bias".
        local: whether each cell is normalised by itself, not all cells of an image or sequence together.
    """

    groups: int
    epsilon: float = 1e-6
    affine: bool = True
    local: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "B *cells C"]) -> Float[Array, "B *cells C"]:
        mean = self._of_cells if self.local else self._of_images
        wide = x.astype(jnp.float32)
        centred = wide - mean(wide)
        out = centred * jax.lax.rsqrt(mean(jnp.square(centred)) + self.epsilon)
        if self.affine:
            scale = parameter(self, "scale", nn.initializers.ones, x.shape[-1:])
            out = out * scale + parameter(self, "bias", nn.initializers.zeros, x.shape[-1:])
        return out.astype(x.dtype)

    def _of_cells(self, x: Array) -> Array:
        """Returns each cell's mean of each group, at every channel of the group."""
        grouped = x.reshape(*x.shape[:-1], self.groups, -1)
        return jnp.broadcast_to(grouped.mean(-1, keepdims=True), grouped.shape).reshape(x.shape)

    def _of_images(self, x: Array) -> Array:
        """Returns each image's mean of each group, at every channel of the group."""
        return self._of_cells(jnp.mean(x, tuple(range(1, x.ndim - 1)), keepdims=True))
