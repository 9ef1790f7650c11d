"""The Diffusion Policy's network (Chi et al. 2023): a 1-D U-Net over controls, conditioned on frames by FiLM.

Axes: B samples, H controls, D numbers of a control, O observed frames, S×S pixels, K keypoints, C channels, F features.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rsjax.layers.group_norm import GroupNorm
from rsjax.tools.policies.config import PolicyConfig


def mish(x: Array) -> Array:
    """Returns x · tanh(softplus(x))."""
    return x * jnp.tanh(jax.nn.softplus(x))


def step_embedding(step: Int[Array, " B"], width: int) -> Float[Array, "B F"]:
    """Returns ``width`` sines and cosines of the noise step, half of each."""
    rates = jnp.exp(-jnp.log(10000.0) / (width // 2 - 1) * jnp.arange(width // 2))
    angles = step[:, None] * rates
    return jnp.concatenate([jnp.sin(angles), jnp.cos(angles)], -1)


class Conv(nn.Module):
    """A 1-D convolution, computed as a matrix product with the values around each place: several times faster on CPUs.

    Args:
        pad: zeros before and after; by default as many as preserve the length.
    """

    channels: int
    kernel: int
    stride: int = 1
    pad: tuple[int, int] | None = None

    @nn.compact
    def __call__(self, x: Float[Array, "B H C"]) -> Float[Array, "B H2 C2"]:
        pad = self.pad or ((self.kernel - 1) // 2, self.kernel // 2)
        wide = jnp.pad(x, ((0, 0), pad, (0, 0)))
        length = x.shape[1]
        around = [wide[:, place : place + length : self.stride] for place in range(self.kernel)]
        return nn.Dense(self.channels)(jnp.concatenate(around, -1))


class Double(nn.Module):
    """Doubles the length: a transposed convolution of kernel 4 and stride 2."""

    @nn.compact
    def __call__(self, x: Float[Array, "B H C"]) -> Float[Array, "B 2H C"]:
        spread = jnp.stack([x, jnp.zeros_like(x)], 2).reshape(len(x), -1, x.shape[-1])
        return Conv(x.shape[-1], 4, pad=(2, 1))(spread)


class ConvBlock(nn.Module):
    """Convolution, group normalisation, Mish."""

    channels: int
    kernel: int
    groups: int

    @nn.compact
    def __call__(self, x: Float[Array, "B H C"]) -> Float[Array, "B H C2"]:
        return mish(GroupNorm(self.groups)(Conv(self.channels, self.kernel)(x)))


class ResidualBlock(nn.Module):
    """Two convolution blocks and a shortcut; the condition scales and shifts the values between them (FiLM)."""

    channels: int
    kernel: int
    groups: int

    @nn.compact
    def __call__(self, x: Float[Array, "B H C"], condition: Float[Array, "B F"]) -> Float[Array, "B H C2"]:
        scale, shift = jnp.split(nn.Dense(2 * self.channels)(mish(condition))[:, None], 2, axis=-1)
        y = ConvBlock(self.channels, self.kernel, self.groups)(x)
        y = ConvBlock(self.channels, self.kernel, self.groups)(scale * y + shift)
        return y + (x if x.shape[-1] == self.channels else nn.Dense(self.channels)(x))


class UNet(nn.Module):
    """Predicts the noise in controls from the noise step and the features of the observation."""

    config: PolicyConfig

    @nn.compact
    def __call__(
        self, x: Float[Array, "B H D"], step: Int[Array, " B"], features: Float[Array, "B F"]
    ) -> Float[Array, "B H D"]:
        cfg = self.config
        width = x.shape[-1]
        embedded = step_embedding(step, cfg.step_embedding)
        embedded = nn.Dense(cfg.step_embedding)(mish(nn.Dense(4 * cfg.step_embedding)(embedded)))
        condition = jnp.concatenate([embedded, features], -1)

        def block(channels: int, x: Array) -> Array:
            return ResidualBlock(channels, cfg.kernel, cfg.groups)(x, condition)

        skips = []
        for level, channels in enumerate(cfg.channels):
            x = block(channels, block(channels, x))
            skips.append(x)
            if level < len(cfg.channels) - 1:
                x = Conv(channels, 3, stride=2)(x)
        x = block(cfg.channels[-1], block(cfg.channels[-1], x))
        for channels in reversed(cfg.channels[:-1]):
            x = jnp.concatenate([x, skips.pop()], -1)
            x = block(channels, block(channels, x))
            x = Double()(x)
        x = ConvBlock(cfg.channels[0], cfg.kernel, cfg.groups)(x)
        return nn.Dense(width)(x)


class Vision(nn.Module):
    """A ResNet with group normalisation and a spatial softmax: finds K keypoints and turns them into F features."""

    config: PolicyConfig

    @nn.compact
    def __call__(self, pictures: Float[Array, "B S S 3"]) -> Float[Array, "B F"]:
        cfg = self.config
        x = nn.Conv(cfg.vision[0], (7, 7), strides=(2, 2), use_bias=False)(pictures)
        x = nn.relu(GroupNorm(self._groups(cfg.vision[0]))(x))
        if cfg.pool:
            x = nn.max_pool(x, (3, 3), strides=(2, 2), padding="SAME")
        for stage, channels in enumerate(cfg.vision):
            for number in range(cfg.vision_blocks):
                x = self._block(x, channels, 2 if stage and not number else 1)
        return nn.Dense(cfg.features)(spatial_softmax(nn.Conv(cfg.keypoints, (1, 1))(x)))

    def _groups(self, channels: int) -> int:
        return max(1, channels // 16)

    def _block(self, x: Array, channels: int, stride: int) -> Array:
        groups = self._groups(channels)
        y = nn.Conv(channels, (3, 3), strides=(stride, stride), use_bias=False)(x)
        y = nn.relu(GroupNorm(groups)(y))
        y = GroupNorm(groups)(nn.Conv(channels, (3, 3), use_bias=False)(y))
        if x.shape != y.shape:
            x = GroupNorm(groups)(nn.Conv(channels, (1, 1), strides=(stride, stride), use_bias=False)(x))
        return nn.relu(x + y)


def spatial_softmax(maps: Float[Array, "B h w K"]) -> Float[Array, "B 2K"]:
    """Returns the expected place under each map's softmax, all x before all y, from -1 to 1 across the map."""
    height, width = maps.shape[1:3]
    mass = jax.nn.softmax(maps.reshape(len(maps), -1, maps.shape[-1]), axis=1).reshape(maps.shape)
    x = jnp.einsum("bhwk,w->bk", mass, jnp.linspace(-1, 1, width))
    y = jnp.einsum("bhwk,h->bk", mass, jnp.linspace(-1, 1, height))
    return jnp.concatenate([x, y], -1)


class PolicyNet(nn.Module):
    """The whole network: features of all observed frames, then the U-Net."""

    config: PolicyConfig

    def setup(self) -> None:
        self.vision = Vision(self.config)
        self.unet = UNet(self.config)

    def __call__(
        self, controls: Float[Array, "B H D"], step: Int[Array, " B"], frames: Float[Array, "B O S S 3"]
    ) -> Float[Array, "B H D"]:
        return self.unet(controls, step, self.see(frames))

    def see(self, frames: Float[Array, "B O S S 3"]) -> Float[Array, "B F"]:
        """Returns the features of the observed frames, concatenated."""
        features = self.vision(frames.reshape(-1, *frames.shape[2:]))
        return features.reshape(len(frames), -1)

    def denoise(
        self, controls: Float[Array, "B H D"], step: Int[Array, " B"], features: Float[Array, "B F"]
    ) -> Float[Array, "B H D"]:
        """Returns the noise in controls, given the features of the observation."""
        return self.unet(controls, step, features)
