"""Records to training arrays, run inside the loader. Plain numpy, picklable."""

from typing import Any

import numpy as np

from rsjax.clip import Batch
from rsjax.data.codec import Record
from rsjax.data.depth_color import depth_to_color
from rsjax.data.normalization import Normalization
from rsjax.data.order import Arrays


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

    A clip without depth gives RGB alone.

    Args:
        flip: mirror each image left to right with probability ½.

    Returns:
        images: uint8 (count, H, W, 3).
    """
    chosen = rng.choice(len(record["rgb"]), count, replace=count > len(record["rgb"]))
    images = record["rgb"][chosen]
    as_depth = rng.random(count) < depth_share
    if record["depth"] is not None:
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


TOKEN_ARRAYS = ("rgb", "depth", "actions", "tracks", "visible", "has_depth")


def token_clip(units: Normalization, integrate: bool, record: Record, rng: np.random.Generator) -> Arrays:
    """The arrays of a token record that a training step reads.

    Args:
        units: those of the model's own data, whichever store the record is from.
        integrate: whether the actions' sums follow them (see ``Normalization.action_inputs``).
    """
    has_depth = record["depth"] is not None
    return {
        "rgb": record["rgb"],
        "depth": record["depth"] if has_depth else np.zeros_like(record["rgb"]),
        "actions": units.action_inputs(record["actions"], integrate),
        "tracks": record["tracks"],
        "visible": record["visible"],
        "has_depth": np.array(has_depth, np.float32),
    }


def token_batch(arrays: Arrays) -> Batch:
    """Stacked :func:`token_clip` as a :class:`Batch`.

    Every clip counts and is numbered by its row where ``weight`` and ``index`` do not say otherwise.
    """
    size = len(arrays["rgb"])
    given = {"weight": np.ones(size, np.float32), "index": np.arange(size, dtype=np.int32)} | arrays
    return Batch(**{name: given[name] for name in (*TOKEN_ARRAYS, "weight", "index")})
