"""Makes shifted copies of a clip: the same scene through a camera that points a few pixels elsewhere.

If a frame is shifted by less than a token's width, the tokens of all its cells change. A model that sees such copies
therefore learns how things move rather than which tokens the training clips have.
"""

import numpy as np
from jaxtyping import Float

from rsjax.clip import Array
from rsjax.data.codec import Record


def moved(images: Array, right: int, down: int) -> Array:
    """Returns images (T, H, W, …) whose content is shifted; pixels that come into view repeat the border."""
    height, width = images.shape[1:3]
    rows = np.clip(np.arange(height) - down, 0, height - 1)
    columns = np.clip(np.arange(width) - right, 0, width - 1)
    return images[:, rows[:, None], columns]


def moved_tracks(record: Record, move: Float[np.ndarray, " 2"]) -> Record:
    """Returns a record's tracks and their visibility after its frames are shifted; points that leave are not visible.

    Args:
        move: the shift to the right and down, in widths of the image.
    """
    tracks = record["tracks"] + move
    inside = ((tracks >= 0) & (tracks <= 1)).all(axis=-1)
    return {"tracks": np.clip(tracks, 0, 1).astype(np.float32), "visible": record["visible"] & inside}
