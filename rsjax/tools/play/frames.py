"""Makes binary messages: a small header, then a picture."""

import io
import struct
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, UInt8
from PIL import Image

HEADER = struct.Struct("<BBHIIBBHHHf")  # version, kind, branch, frame, id, format, 0, width, height, 0, scale
VERSION = 1
RAW = 0
WEBP = 2
KINDS = {"rgb": 1, "depth": 2, "truth": 3, "truth_depth": 4, "uncertainty": 5}
LOSSLESS = 128  # pixels per side, up to which pictures are sent without loss


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
