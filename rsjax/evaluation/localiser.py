"""Reads where cube and gripper are in a frame and whether the cube is lifted, by a network trained on true frames.

The localiser measures what a picture shows: a blurred frame can have everything in its place, and a sharp frame
nothing. In training, the true frames are moved and blurred, so that the network can also read blurred frames
(notebooks/miniature.md).

Axes: B frames, H×W pixels; 2 objects: cube, gripper.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn
from jaxtyping import Array, Float, Float32, Int, UInt8
from scipy.special import expit

from rsjax.data.codec import Record
from rsjax.data.shift import moved
from rsjax.data.state_labels import recorded_objects
from rsjax.evaluation.registry import Places
from rsjax.layers.group_norm import GroupNorm
from rsjax.progress import Progress

OBJECTS = ("cube", "gripper")
BATCH = 64  # frames per training step
MOVE = 8  # frames are moved by up to 1/MOVE of their width and height
SPREAD = 0.03  # standard deviation of the Gaussian around an object that is the softmax's target, in frame widths


def recorded_places(clips: Sequence[Record]) -> tuple[Places, Float[np.ndarray, " B"]] | None:
    """Returns the places that the simulator recorded for all frames (B, T, …), and the cubes' widths.

    They are in the clips' provenance. Returns None if one of the clips does not have them.
    """
    objects = [recorded_objects(clip["provenance"]) for clip in clips]
    cube = "cube" if "cube" in objects[0] else "object"  # Meta-World's main object stands for the cube
    if not all(name in each for each in objects for name in (cube, "gripper", f"{cube}_width")):
        return None
    xy = np.stack([np.stack([each[name] for name in (cube, "gripper")], axis=1) for each in objects])
    lifted = np.stack([clip["success"] for clip in clips])
    return Places(np.clip(xy, 0, 1), lifted), np.array([each[f"{cube}_width"] for each in objects])


class LocaliserNetwork(nn.Module):
    """A U-Net; an object's place is the mean under a softmax over cells, where each cell adds a learned correction."""

    @nn.compact
    def __call__(self, rgb: Array) -> tuple[Float[Array, "B 2 2"], Float[Array, " B"], Float[Array, "B n 2"]]:
        """Returns places, the logit of "lifted", and the softmax's log-probabilities of the n cells of 2×2 pixels."""
        fine = layer(nn.Conv(16, (4, 4), (2, 2))(rgb.astype(jnp.float32) / 127.5 - 1))
        fine = layer(nn.Conv(16, (3, 3))(fine))
        middle = layer(nn.Conv(32, (3, 3), (2, 2))(fine))
        middle = layer(nn.Conv(32, (3, 3))(middle))
        coarse = layer(nn.Conv(64, (3, 3), (2, 2))(middle))
        coarse = layer(nn.Conv(64, (3, 3))(coarse))
        middle = layer(nn.Conv(32, (3, 3))(middle) + enlarged(nn.Conv(32, (1, 1))(coarse), middle))
        fine = layer(nn.Conv(16, (3, 3))(fine) + enlarged(nn.Conv(16, (1, 1))(middle), fine))
        fine = layer(nn.Conv(16, (3, 3))(fine))

        b, h, w, _ = fine.shape
        log_p = jax.nn.log_softmax(nn.Conv(len(OBJECTS), (1, 1))(fine).reshape(b, h * w, -1), axis=1)
        corrections = nn.Conv(2 * len(OBJECTS), (1, 1), kernel_init=nn.initializers.zeros)(fine)
        at = _centres(h, w)[:, None] + 0.05 * corrections.reshape(b, h * w, -1, 2)
        xy = jnp.einsum("bno,bnoc->boc", jnp.exp(log_p), at)
        features = jnp.concatenate([fine, enlarged(middle, fine)], -1).reshape(b, h * w, -1)
        around = jnp.einsum("bno,bnc->boc", jnp.exp(log_p), features)  # features at the objects
        at_objects = jnp.concatenate([around.reshape(b, -1), xy.reshape(b, -1)], -1)
        return xy, nn.Dense(1)(nn.relu(nn.Dense(32)(at_objects)))[:, 0], log_p


def layer(x: Array) -> Array:
    """Normalises and rectifies features."""
    return nn.relu(GroupNorm(8)(x))


def enlarged(x: Array, like: Array) -> Array:
    """Repeats each cell 2×2 times, up to the size of ``like``."""
    return x.repeat(2, axis=1).repeat(2, axis=2)[:, : like.shape[1], : like.shape[2]]


def _centres(h: int, w: int) -> Float[Array, "n 2"]:
    rows, columns = jnp.divmod(jnp.arange(h * w), w)
    return jnp.stack([(columns + 0.5) / w, (rows + 0.5) / h], -1)


@dataclass(frozen=True)
class Localiser:
    """A trained network."""

    params: Any

    def __call__(self, rgb: UInt8[np.ndarray, "B H W 3"], batch: int = 256) -> Places:
        """Returns where cube and gripper are in frames, and whether the cube is lifted."""
        xy, logit = self._read(rgb, batch)
        return Places(np.clip(xy, 0, 1), logit > 0)

    def lifted(self, rgb: UInt8[np.ndarray, "B H W 3"], batch: int = 256) -> Float[np.ndarray, " B"]:
        """Returns the probability that the cube is lifted, for each frame."""
        _, logit = self._read(rgb, batch)
        return expit(logit)

    def _read(
        self, rgb: UInt8[np.ndarray, "B H W 3"], batch: int
    ) -> tuple[Float[np.ndarray, "B 2 2"], Float[np.ndarray, " B"]]:
        """Returns places and the logit of "lifted"."""
        rows = [np.minimum(np.arange(i, i + batch), len(rgb) - 1) for i in range(0, len(rgb), batch)]
        parts = [_apply(self.params, rgb[each]) for each in rows]
        xy, logit = (np.concatenate([np.asarray(part[i]) for part in parts])[: len(rgb)] for i in (0, 1))
        return xy, logit


def train_localiser(clips: Sequence[Record], steps: int) -> Localiser:
    """Trains a network on the true frames of clips that record places; the result depends only on the arguments."""
    recorded = recorded_places(clips)
    assert recorded is not None
    frames = np.concatenate([clip["rgb"] for clip in clips])
    xy = recorded[0].xy.reshape(-1, 2, 2)
    lifted = recorded[0].lifted.reshape(-1)

    params = jax.jit(LocaliserNetwork().init)(jax.random.key(0), frames[:1])
    optimizer = optax.adam(optax.cosine_decay_schedule(3e-3, steps))
    state = optimizer.init(params)
    rng = np.random.default_rng(0)

    def loss(params: Any, frames: Array, xy: Array, lifted: Array) -> Array:
        places, logit, log_p = _apply(params, frames)
        offsets = _centres(-(-frames.shape[1] // 2), -(-frames.shape[2] // 2))[:, None] - xy[:, None]  # B n 2 2
        near = jax.nn.softmax(-jnp.square(offsets).sum(-1) / (2 * SPREAD**2), axis=1)
        # Absolute, not squared, errors: a hidden cube has a large error, which must not dominate the others.
        error = 10 * jnp.abs(places - xy).mean() - 0.3 * (near * log_p).sum(1).mean()
        return error + optax.sigmoid_binary_cross_entropy(logit, lifted).mean()

    @jax.jit
    def step(params: Any, state: Any, frames: Array, xy: Array, lifted: Array) -> tuple[Any, Any]:
        updates, state = optimizer.update(jax.grad(loss)(params, frames, xy, lifted), state)
        return optax.apply_updates(params, updates), state

    with Progress("localiser", steps, "steps") as progress:
        for number in range(steps):
            rows: Int[np.ndarray, " B"] = rng.integers(0, len(frames), BATCH)
            images, places = varied(rng, frames[rows], xy[rows])
            params, state = step(params, state, images, places, lifted[rows])
            progress.update(number + 1)
    return Localiser(params)


def varied(
    rng: np.random.Generator, frames: UInt8[np.ndarray, "B H W 3"], xy: Float[np.ndarray, "B 2 2"]
) -> tuple[Float32[np.ndarray, "B H W 3"], Float[np.ndarray, "B 2 2"]]:
    """Moves frames and their places at random, repeating borders, and blurs each frame by a random amount."""
    size = np.array(frames.shape[2:0:-1])  # width, height
    moves = rng.integers(-(size // MOVE), size // MOVE + 1, (len(frames), 2))  # right, down
    images = np.empty(frames.shape, np.float32)
    for image, frame, move, shares in zip(images, frames, moves, rng.random((len(frames), 2)), strict=True):
        image[:] = moved(frame[None], *move)[0]
        blur(image, shares)
    return images, np.clip(xy + moves[:, None] / size, 0, 1)


def blur(image: Float32[np.ndarray, "H W 3"], shares: Float[np.ndarray, " N"]) -> None:
    """Blurs an image in place, by each share in turn, from 0 to 1."""
    for share in shares:
        image += share * (cv2.GaussianBlur(image, (5, 5), 0, borderType=cv2.BORDER_REPLICATE) - image)


@jax.jit
def _apply(params: Any, frames: Array) -> tuple[Array, Array, Array]:
    return cast(tuple[Array, Array, Array], LocaliserNetwork().apply(params, frames))
