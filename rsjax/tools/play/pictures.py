"""The pictures of the protocol: those that a page uploads as first frames, and those that it is sent."""

import io
import struct
import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, UInt8
from PIL import Image, ImageOps

from rsjax.tools.play.messages import Refused

FORMATS = ("PNG", "JPEG", "WEBP")
MOST_SIDE = 4096  # pixels
LEAST_SIDE = 8
HEADER = struct.Struct("<BBHIIBBHHHf")  # version, kind, branch, frame, id, format, 0, width, height, 0, scale
VERSION = 1
RAW = 0
WEBP = 2
KINDS = {"rgb": 1, "depth": 2, "truth": 3, "truth_depth": 4, "uncertainty": 5}
LOSSLESS = 128  # pixels per side, up to which pictures are sent without loss


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
        Refused: the payload is not such a picture, or the picture is damaged, too large or too small.
    """
    try:
        strict = warnings.catch_warnings(action="error", category=Image.DecompressionBombWarning)
        with strict, Image.open(io.BytesIO(payload), formats=FORMATS) as image:
            width, height = image.size
            if max(width, height) > MOST_SIDE or min(width, height) < LEAST_SIDE:
                sides = f"{LEAST_SIDE} to {MOST_SIDE} pixels a side"
                raise Refused("bad_image", f"the picture has {width} × {height} pixels; it can have {sides}")
            upright = ImageOps.exif_transpose(image).convert("RGB")
    except Refused:
        raise
    except Exception as error:  # decoders raise all kinds of exceptions for damaged files
        raise Refused("bad_image", "this is not a PNG, JPEG or WebP picture that can be read") from error
    square = min(upright.size)
    middle = ImageOps.fit(upright, (square, square))
    if square == side:
        scaled = middle
    else:
        scaled = middle.resize((side, side), Image.Resampling.LANCZOS)
    return Upload(np.asarray(scaled), upright.size, square)


class Place(NamedTuple):
    """The frame that a picture shows, and the id of the message that it answers (0: none)."""

    branch: int
    frame: int
    id: int


def picture(kind: str, place: Place, rgb: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """Returns the message with an RGB picture as WebP, lossless if it is small."""
    return _message(kind, place, WEBP, rgb.shape, webp(rgb), 0.0)


def depth_picture(kind: str, place: Place, depth: Float32[np.ndarray, "H W"], near: float, far: float) -> bytes:
    """Returns the message with a depth map as a grey picture: 0 is ``near``, 255 is ``far``, linear in metres."""
    share = np.clip((np.nan_to_num(depth, nan=far) - near) / (far - near), 0, 1)
    grey = np.round(255 * share).astype(np.uint8)
    return _message(kind, place, WEBP, grey.shape, webp(np.repeat(grey[..., None], 3, -1)), far)


def uncertainty(place: Place, entropy: Float[np.ndarray, " S"], bits: int) -> bytes:
    """Returns the message with tokens' entropies (nats) as bytes: 255 means ``bits``, the maximum for a token."""
    side = int(np.sqrt(len(entropy)))
    share = np.clip(entropy / np.log(2) / bits, 0, 1)
    return _message("uncertainty", place, RAW, (side, side), np.round(255 * share).astype(np.uint8).tobytes(), bits)


def webp(rgb: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """Returns a picture as WebP, lossless if it is small."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, "WEBP", lossless=len(rgb) <= LOSSLESS, quality=80, method=0)
    return buffer.getvalue()


def _message(kind: str, place: Place, form: int, shape: tuple[int, ...], payload: bytes, scale: float) -> bytes:
    numbers = (VERSION, KINDS[kind], place.branch, place.frame, place.id, form, 0, shape[1], shape[0], 0, scale)
    return HEADER.pack(*numbers) + payload
