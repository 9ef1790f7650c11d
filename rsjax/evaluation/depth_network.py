"""Estimates depth from frames by a small network that is trained on clips with exact depth, as a simulator has it.

The network gives every model depth scores, also models without depth, and in metres. In training, the true frames are
blurred by random amounts and change in brightness and colour, so that the network can also read generated frames.

Axes: B frames, T frames of a video, H×W pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Float32, UInt8

from rsjax.data.clips import spread
from rsjax.data.codec import Record
from rsjax.evaluation.depth_estimator import DepthMaps
from rsjax.evaluation.localiser import blur, enlarged, layer
from rsjax.progress import Progress
from rsjax.trainable import Params

BATCH = 16  # frames per training step
WIDTHS = (24, 48, 96, 128)  # channels at 1/2, 1/4, 1/8 and 1/16 of the frame's size
LEARNING_RATE = 3e-3
COLOUR = 0.1  # standard deviation of the factors and shifts of the colours
OFFSET_CLIPS = 50  # clips whose mean depth training starts from
PER_CALL = 16  # frames that are estimated at once


class DepthUNet(nn.Module):
    """A U-Net from frames to the logarithm of depth in metres.

    Attributes:
        first: its output everywhere before it has learned anything.
    """

    first: float = 0.0

    @nn.compact
    def __call__(self, rgb: Float[Array, "B H W 3"]) -> Float[Array, "B H W"]:
        """Returns the logarithm of each pixel's depth; values 0–255."""
        pixels = rgb.astype(jnp.float32) / 127.5 - 1
        rows, columns = jnp.meshgrid(*(jnp.linspace(-1, 1, size) for size in rgb.shape[1:3]), indexing="ij")
        place = jnp.broadcast_to(jnp.stack([rows, columns], -1), (*rgb.shape[:3], 2))
        x = jnp.concatenate([pixels, place], -1)
        levels = []
        for width in WIDTHS:
            x = layer(nn.Conv(width, (4, 4), (2, 2))(x))
            x = layer(nn.Conv(width, (3, 3))(x))
            levels.append(x)
        for finer in levels[-2::-1]:
            x = finer + enlarged(nn.Conv(finer.shape[-1], (1, 1))(x), finer)
            x = layer(nn.Conv(finer.shape[-1], (3, 3))(x))
        x = nn.Conv(8, (3, 3))(pixels) + enlarged(nn.Conv(8, (1, 1))(x), pixels)
        start = nn.initializers.constant(self.first)
        return nn.Conv(1, (3, 3), kernel_init=nn.initializers.zeros, bias_init=start)(nn.relu(x))[..., 0]


@dataclass(frozen=True)
class DepthNetwork:
    """A trained network: a :data:`rsjax.evaluation.depth_estimator.DepthEstimator` in metres."""

    params: Params

    def __call__(self, frames: UInt8[np.ndarray, "T H W 3"]) -> DepthMaps:
        """Estimates the depth of a video's frames."""
        parts = []
        for start in range(0, len(frames), PER_CALL):
            rows = np.minimum(np.arange(start, start + PER_CALL), len(frames) - 1)  # repeats the last frame
            parts.append(np.asarray(log_depth(self.params, frames[rows])))
        depth = np.exp(np.concatenate(parts)[: len(frames)])
        return DepthMaps(depth, "metres", (float(depth.min()), float(depth.max())))


def initial(size: int, first: float = 0.0) -> Params:
    """Returns the parameters before training, for square frames of ``size`` pixels per side."""
    return dict(jax.jit(DepthUNet(first).init)(jax.random.key(0), jnp.zeros((1, size, size, 3))))


def train_depth_network(clips: Sequence[Record], steps: int) -> DepthNetwork:
    """Trains a network on all clips' frames and depth; the result depends only on the arguments.

    Args:
        clips: with depth in metres; pixels of depth 0 have none.
    """
    some = np.stack([clips[number]["depth"] for number in spread(clips, OFFSET_CLIPS)])
    params = initial(clips[0]["rgb"].shape[2], float(np.log(some[some > 0]).mean()))
    optimizer = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, steps))
    state = optimizer.init(params)

    @jax.jit
    def step(params: Params, state: Any, frames: Array, depth: Array) -> tuple[Params, Any]:
        updates, state = optimizer.update(jax.grad(loss)(params, frames, depth), state)
        return optax.apply_updates(params, updates), state

    rng = np.random.default_rng(0)
    with Progress("depth estimator", steps, "steps") as progress:
        for number in range(steps):
            chosen = [clips[row] for row in rng.integers(0, len(clips), BATCH)]
            at = [rng.integers(0, len(clip["rgb"])) for clip in chosen]
            frames = np.stack([clip["rgb"][t] for clip, t in zip(chosen, at, strict=True)])
            depth = np.stack([clip["depth"][t] for clip, t in zip(chosen, at, strict=True)])
            params, state = step(params, state, varied(rng, frames), depth)
            progress.update(number + 1)
    return DepthNetwork(params)


def loss(params: Params, frames: Float[Array, "B H W 3"], depth: Float[Array, "B H W"]) -> Float[Array, ""]:
    """Returns the mean of |log d̂ - log d| over the pixels with depth; for small errors, AbsRel."""
    known = depth > 0
    error = jnp.abs(log_depth(params, frames) - jnp.log(jnp.where(known, depth, 1.0)))
    return jnp.sum(error, where=known) / jnp.maximum(known.sum(), 1)


def varied(rng: np.random.Generator, frames: UInt8[np.ndarray, "B H W 3"]) -> Float32[np.ndarray, "B H W 3"]:
    """Blurs each frame by a random amount, and scales and shifts its colours."""
    images = frames.astype(np.float32)
    for image, shares in zip(images, rng.random((len(frames), 2)), strict=True):
        blur(image, shares)
    factors = rng.normal(1, COLOUR, (len(frames), 1, 1, 3))
    shifts = 255 * rng.normal(0, COLOUR / 2, (len(frames), 1, 1, 3))
    return np.clip(factors * images + shifts, 0, 255).astype(np.float32)


@jax.jit
def log_depth(params: Params, frames: Array) -> Float[Array, "B H W"]:
    """Returns the logarithm of the depth of each pixel."""
    return cast(Array, DepthUNet().apply(params, frames))
