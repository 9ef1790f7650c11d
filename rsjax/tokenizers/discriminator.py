"""The PatchGAN discriminator of the tokenizer's adversarial training (pix2pix; sizes of the public Open-MAGVIT2).

Submodule names follow the public keys ``loss.discriminator.main.{i}``.

Axes: B images, H×W pixels, h×w patches, C channels.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

MIN_SIZE = 24  # smallest image side in pixels, which gives one patch
_WIDTH = 64


class BatchNorm(nn.Module):
    """Normalises by the batch's own mean and (biased) variance.

    There are no running averages, since the discriminator is used only in training.

    Args:
        axis_name: pmap's axis over which the batch is split. Statistics are those of the whole batch, so that results
            do not depend on the sharding; the public code uses those of each GPU.
    """

    axis_name: str | None = None

    @nn.compact
    def __call__(self, x: Float[Array, "B h w C"]) -> Float[Array, "B h w C"]:
        scale = self.param("scale", lambda key: 1 + 0.02 * jax.random.normal(key, x.shape[-1:]))
        bias = self.param("bias", nn.initializers.zeros, x.shape[-1:])
        mean = self._over_batch(x)
        variance = self._over_batch(jnp.square(x - mean))
        return (x - mean) * jax.lax.rsqrt(variance + 1e-5) * scale + bias

    def _over_batch(self, x: Float[Array, "B h w C"]) -> Float[Array, " C"]:
        mean = jnp.mean(x, axis=(0, 1, 2))
        if self.axis_name is None:
            return mean
        return jax.lax.pmean(mean, self.axis_name)


class Discriminator(nn.Module):
    """Maps images in [-1, 1] to one logit per patch of 70×70 pixels; positive means real.

    Args:
        axis_name: see :class:`BatchNorm`.
    """

    axis_name: str | None = None

    @nn.compact
    def __call__(self, images: Float[Array, "B H W 3"]) -> Float[Array, "B h w"]:
        x = nn.leaky_relu(_conv(_WIDTH, 0, stride=2, bias=True)(images), 0.2)
        for index, features, stride in ((2, 2 * _WIDTH, 2), (5, 4 * _WIDTH, 2), (8, 8 * _WIDTH, 1)):
            x = _conv(features, index, stride)(x)
            x = BatchNorm(self.axis_name, name=f"main_{index + 1}")(x)
            x = nn.leaky_relu(x, 0.2)
        return _conv(1, 11, bias=True)(x)[..., 0]

    def init_params(self, key: Array) -> Any:
        """Returns fresh parameters: weights ~ N(0, 0.02²), norms' scales ~ N(1, 0.02²)."""
        return self.init(key, jnp.zeros((1, MIN_SIZE, MIN_SIZE, 3)))["params"]


def _conv(features: int, index: int, stride: int = 1, bias: bool = False) -> nn.Conv:
    return nn.Conv(
        features,
        (4, 4),
        (stride, stride),
        padding=((1, 1), (1, 1)),
        use_bias=bias,
        kernel_init=nn.initializers.normal(0.02),
        name=f"main_{index}",
    )
