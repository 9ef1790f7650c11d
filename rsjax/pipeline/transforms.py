"""Records to training arrays, run inside the loader. Plain numpy, picklable."""

from typing import Any

import numpy as np

from rsjax.clip import Batch
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
    flip: bool,
) -> Arrays:
    """``count`` random frames of a clip, each as RGB or, with probability ``depth_share``, as colourised depth.

    Args:
        flip: mirror each image left to right with probability ½.

    Returns:
        images: uint8 (count, H, W, 3).
    """
    chosen = rng.choice(len(record["rgb"]), count, replace=count > len(record["rgb"]))
    images = record["rgb"][chosen]
    as_depth = rng.random(count) < depth_share
    near, far = record["provenance"]["depth_range"]
    colors = depth_to_color(record["depth"][chosen[as_depth]], near, far, scale)
    images[as_depth] = colors.astype(np.uint8)
    if flip:
        mirrored = rng.random(count) < 0.5
        images[mirrored] = images[mirrored, :, ::-1]
    return {"images": images}


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
