"""Fits recorded pictures, depth maps and tracks into the square of a clip.

A camera's pictures may differ in resolution from its depth maps, so all positions are shares of a side.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

Fit = Literal["crop", "pad", "stretch"]
_DONE = {
    "crop": "cropped to the middle square (--fit pad or stretch keeps the rest)",
    "pad": "padded to a square with black bars, which have no depth",
    "stretch": "stretched to a square, so proportions change",
}


@dataclass(frozen=True)
class Placement:
    """Where a recorded picture lies in the square: position x of the picture is ``scale * x + offset`` of the square.

    Attributes:
        scale: for x and y; 0 and 1 are the outer edges of the picture and of the square.
        offset: likewise.
        size: side of the square in pixels.
        words: how the pictures become square, such as ``640 × 480 cropped …``; "" if they are square.
    """

    scale: tuple[float, float]
    offset: tuple[float, float]
    size: int
    words: str = ""

    @classmethod
    def create(cls, fit: Fit, height: int, width: int, size: int) -> "Placement":
        """Places a picture of H×W pixels in a square of S×S, at whole pixels of the picture (crop) or square (pad)."""
        words = "" if height == width else f"{width} × {height} {_DONE[fit]}"
        if fit == "crop":
            side = min(height, width)
            left, top = (width - side) // 2, (height - side) // 2
            return cls((width / side, height / side), (-left / side, -top / side), size, words)
        if fit == "pad":
            inner = [max(1, round(size * side / max(height, width))) for side in (width, height)]
            x, y = ((size - side) // 2 / size for side in inner)
            return cls((inner[0] / size, inner[1] / size), (x, y), size, words)
        return cls((1.0, 1.0), (0.0, 0.0), size, words)

    def picture(self, picture: np.ndarray) -> np.ndarray:
        """Returns a picture or depth map as S×S pixels; pixels that it does not cover are 0 (black, or no depth).

        A resized pixel is a mean over an area of the picture, but the nearest value of a depth map, because a mean of
        two surfaces lies on neither.
        """
        source: list[slice] = []
        target: list[slice] = []
        for axis, side in ((1, picture.shape[0]), (0, picture.shape[1])):  # rows are y
            scale, offset = self.scale[axis], self.offset[axis]
            source.append(_pixels(-offset / scale, (1 - offset) / scale, side))
            target.append(_pixels(offset, offset + scale, self.size))
        method = cv2.INTER_AREA if picture.ndim == 3 else cv2.INTER_NEAREST_EXACT
        rows, columns = target
        seen = picture[tuple(source)]
        small = cv2.resize(seen, (columns.stop - columns.start, rows.stop - rows.start), interpolation=method)
        if small.shape[:2] == (self.size, self.size):
            return small
        square = np.zeros((self.size, self.size, *picture.shape[2:]), picture.dtype)
        square[rows, columns] = small
        return square

    def tracks(
        self, points: Float[np.ndarray, "P T 2"], visible: Bool[np.ndarray, "P T"]
    ) -> tuple[Float32[np.ndarray, "P T 2"], Bool[np.ndarray, "P T"]]:
        """Maps points of the picture to points of the square; points that were cut off are not visible."""
        placed = (points * np.array(self.scale) + np.array(self.offset)).astype(np.float32)
        if max(self.scale) > 1:
            visible = visible & ((placed >= 0) & (placed <= 1)).all(-1)
        return placed, visible


def _pixels(first: float, end: float, side: int) -> slice:
    """Returns the pixels between two shares of a side: at least one, and none outside."""
    start = min(max(0, round(first * side)), side - 1)
    return slice(start, max(start + 1, min(side, round(end * side))))
