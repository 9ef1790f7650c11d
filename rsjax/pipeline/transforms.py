"""Records to training arrays, run inside the loader. Plain numpy, picklable."""

from typing import Any

import numpy as np

from rsjax.clip import Batch
from rsjax.config import require
from rsjax.data.loader import Arrays
from rsjax.data.store import Record
from rsjax.tokenizer.depth_color import depth_to_color


def tokenizer_images(
    record: Record,
    rng: np.random.Generator,
    *,
    count: int,
    depth_share: float,
    scale: Any,
    size: int,
    flip: bool,
) -> Arrays:
    """``count`` random frames of a clip, each as RGB or, with probability ``depth_share``, as colourised depth.

    Args:
        size: side of the images; larger ones are cropped, each at a place of its own.
        flip: mirror each image left to right with probability ½.

    Returns:
        images: uint8 (count, size, size, 3).

    Raises:
        ConfigError: the clip's images are smaller than ``size``.
    """
    chosen = rng.choice(len(record["rgb"]), count, replace=count > len(record["rgb"]))
    images = record["rgb"][chosen]
    as_depth = rng.random(count) < depth_share
    near, far = record["provenance"]["depth_range"]
    colors = depth_to_color(record["depth"][chosen[as_depth]], near, far, scale)
    images[as_depth] = colors.astype(np.uint8)
    images = _crop(images, rng, size)
    if flip:
        mirrored = rng.random(count) < 0.5
        images[mirrored] = images[mirrored, :, ::-1]
    return {"images": images}


def _crop(images: np.ndarray, rng: np.random.Generator, size: int) -> np.ndarray:
    height, width = images.shape[1:3]
    require(
        min(height, width) >= size,
        f"a clip's images are {height}×{width} but tokenizer.image_size is {size}; lower it or use larger images",
    )
    if height == width == size:
        return images
    rows, columns = (rng.integers(0, side - size + 1, len(images)) for side in (height, width))
    return np.stack([x[r : r + size, c : c + size] for x, r, c in zip(images, rows, columns, strict=True)])


def image_batch(arrays: Arrays) -> np.ndarray:
    """Stacked :func:`tokenizer_images` as one batch of images."""
    images = arrays["images"]
    return images.reshape(-1, *images.shape[2:])


def token_clip(record: Record, rng: np.random.Generator) -> Arrays:
    """The arrays of a token record that a training step reads."""
    return {name: record[name] for name in ("rgb", "depth", "actions", "tracks", "visible")}


def token_batch(arrays: Arrays) -> Batch:
    """Stacked :func:`token_clip` as a :class:`Batch` in which every clip counts."""
    size = len(arrays["rgb"])
    return Batch(**arrays, weight=np.ones(size, np.float32), index=np.arange(size, dtype=np.int32))
