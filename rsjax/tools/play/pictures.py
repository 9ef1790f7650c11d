"""Makes a first frame from an uploaded picture."""

import io
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps

from rsjax.tools.play.errors import Refused

FORMATS = ("PNG", "JPEG", "WEBP")
MOST_SIDE = 4096  # pixels
LEAST_SIDE = 8


@dataclass(frozen=True)
class Upload:
    """A picture as a first frame.

    Attributes:
        rgb: the frame, in the model's size.
        size: width and height of the picture.
        square: side of the square that was cut from the middle of the picture and scaled.
    """

    rgb: UInt8[np.ndarray, "S S 3"]
    size: tuple[int, int]
    square: int

    def describe(self) -> dict[str, Any]:
        """Returns the description of the picture for a page."""
        return {"from": list(self.size), "cropped": [self.square, self.square], "to": len(self.rgb)}

    @property
    def message(self) -> str:
        """Says in words what was done to the picture."""
        width, height = self.size
        if width == height:
            cut = ""
        else:
            cut = f"cut to its middle {self.square} × {self.square}, "
        side = len(self.rgb)
        return f"{width} × {height} pixels, {cut}{'kept' if self.square == side else f'scaled to {side} × {side}'}"


def read_picture(payload: bytes, side: int) -> Upload:
    """Decodes a PNG, JPEG or WebP picture, and cuts and scales it to a square.

    Raises:
        Refused: the payload is no such picture, or the picture is damaged, too large or too small.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(payload), formats=FORMATS) as image:
                _check_size(*image.size)
                upright = ImageOps.exif_transpose(image).convert("RGB")
    except Refused:
        raise
    except Exception as error:  # decoders raise all kinds of exceptions for damaged files
        raise Refused("bad_image", "this is no PNG, JPEG or WebP picture that can be read") from error
    square = min(upright.size)
    middle = ImageOps.fit(upright, (square, square))
    if square == side:
        scaled = middle
    else:
        scaled = middle.resize((side, side), Image.Resampling.LANCZOS)
    return Upload(np.asarray(scaled), upright.size, square)


def _check_size(width: int, height: int) -> None:
    if max(width, height) > MOST_SIDE or min(width, height) < LEAST_SIDE:
        sides = f"{LEAST_SIDE} to {MOST_SIDE} pixels a side"
        raise Refused("bad_image", f"the picture has {width} × {height} pixels; it can have {sides}")
