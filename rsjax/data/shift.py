"""Moved copies of a clip: the same scene through a camera that points a few pixels elsewhere.

The tokens of a picture that is moved by less than a token differ in every cell, so a model that sees such copies learns
how things move and not which tokens the training clips have.
"""

import numpy as np
from jaxtyping import Float

from rsjax.clip import Array
from rsjax.data.codec import Record


def moved(images: Array, right: int, down: int) -> Array:
    """Returns images (T, H, W, …) whose content is moved; what comes into view repeats the border."""
    height, width = images.shape[1:3]
    rows = np.clip(np.arange(height) - down, 0, height - 1)
    columns = np.clip(np.arange(width) - right, 0, width - 1)
    return images[:, rows[:, None], columns]


def moved_tracks(record: Record, move: Float[np.ndarray, " 2"]) -> Record:
    """Returns the tracks and the visibility of a record whose pictures were moved; points that leave are not visible.

    Args:
        move: to the right and down, in widths of the image.
    """
    tracks = record["tracks"] + move
    inside = ((tracks >= 0) & (tracks <= 1)).all(axis=-1)
    return {"tracks": np.clip(tracks, 0, 1).astype(np.float32), "visible": record["visible"] & inside}
