"""Pictures and depth maps that are stored one by one or are in memory, and how they fit into the square of a clip.

A camera's pictures may differ in resolution from its depth maps, so a :class:`Placement` counts in shares of a side.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from rsjax.files import placeholder, regular
from rsjax.tools.ingest.episode import MAX_PIXELS, EpisodeError, reason

_NOT_FRAMES = (0xC4, 0xC8, 0xCC)  # JPEG markers of tables, between the markers of frame headers
Fit = Literal["crop", "pad", "stretch"]
_DONE = {
    "crop": "cropped to the middle square (--fit pad or stretch keeps the rest)",
    "pad": "padded to a square with black bars, which have no depth",
    "stretch": "stretched to a square, so proportions change",
}


@dataclass(frozen=True, eq=False)
class ArrayFrames:
    """Pictures in memory, as ``Frames``, or depth maps, float32 [N, H, W], as ``Depths``."""

    pictures: UInt8[np.ndarray, "N H W 3"] | Float32[np.ndarray, "N H W"]

    def __len__(self) -> int:
        return len(self.pictures)

    def read(self, indices: Sequence[int]) -> np.ndarray:
        """Returns these pictures or maps."""
        return self.pictures[np.asarray(indices, np.int64)]


@dataclass(frozen=True, eq=False)
class EncodedFrames:
    """PNG or JPEG pictures in memory, decoded when they are read, as ``Frames``.

    Attributes:
        payloads: each frame's PNG or JPEG.
        where: the file and field that error messages name.
        depth_scale: if above 0, they are depth maps, as ``Depths``: PNG of whole numbers in units of this many metres,
            or of four channels that are the bytes of float32 metres, as TFDS writes them.
    """

    payloads: Sequence[bytes]
    where: str
    depth_scale: float = 0.0

    def __len__(self) -> int:
        return len(self.payloads)

    def read(self, indices: Sequence[int]) -> np.ndarray:
        """Returns these pictures or maps; :class:`EpisodeError` names one that is damaged or of another size."""
        chosen = ((f"{self.where} frame {index}", self.payloads[index]) for index in indices)
        if self.depth_scale:
            return stack_pictures((where, _depth(data, where, self.depth_scale)) for where, data in chosen)
        return decode_pictures(chosen)


@dataclass(frozen=True, eq=False)
class PictureFiles:
    """One file per frame: PNG or JPEG as ``Frames``, or depth maps as ``Depths``.

    Attributes:
        paths: each frame's file.
        depth: whether they are depth maps: 16-bit PNG in millimetres, 0 where nothing was measured.
    """

    paths: Sequence[Path]
    depth: bool = False

    def __len__(self) -> int:
        return len(self.paths)

    def read(self, indices: Sequence[int]) -> np.ndarray:
        """Returns these pictures, or maps in metres.

        Raises:
            EpisodeError: one is missing, damaged or of another size.
        """
        paths = [self.paths[index] for index in indices]
        if self.depth:
            return stack_pictures((path, _depth(_bytes(path), path, 0.001)) for path in paths)
        return decode_pictures((path, _bytes(path)) for path in paths)


def _depth(payload: bytes, where: Path | str, scale: float) -> Float32[np.ndarray, "H W"]:
    raw = _decode(payload, cv2.IMREAD_UNCHANGED, where)
    if raw.dtype == np.uint8 and raw.ndim == 3 and raw.shape[2] == 4:  # OpenCV stores the red byte third
        metres = np.ascontiguousarray(raw[..., [2, 1, 0, 3]]).view("<f4")[..., 0]
        return np.nan_to_num(metres, nan=0, posinf=0, neginf=0)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise EpisodeError.at(where, f"{raw.dtype} {raw.shape}, a depth map has 16 bits and one channel")
    return raw.astype(np.float32) * np.float32(scale)


def decode_pictures(payloads: Iterable[tuple[Path | str, bytes]]) -> UInt8[np.ndarray, "n H W 3"]:
    """Decodes PNG or JPEG pictures of one size as RGB, rotated as their EXIF data say.

    Args:
        payloads: pairs of what error messages name and the encoded picture.

    Raises:
        EpisodeError: one is damaged, neither PNG nor JPEG, of impossible size, or of another size than the first.
    """
    return stack_pictures((where, _decode(data, cv2.IMREAD_COLOR, where)[..., ::-1]) for where, data in payloads)


def stack_pictures(pictures: Iterable[tuple[Path | str, np.ndarray]]) -> np.ndarray:
    """Stacks pictures or maps of one size; each is paired with what error messages name.

    Raises:
        EpisodeError: one is of another size than the first.
    """
    stacked: list[np.ndarray] = []
    for where, picture in pictures:
        stacked.append(picture)
        if picture.shape != stacked[0].shape:
            sizes = " and ".join(f"{one.shape[1]} × {one.shape[0]}" for one in (picture, stacked[0]))
            raise EpisodeError.at(where, f"pictures of several sizes ({sizes})")
    if not stacked:
        raise ValueError("no frames to read")
    return np.stack(stacked)


def _decode(payload: bytes, flags: int, where: Path | str) -> np.ndarray:
    """Decodes a picture after a check of its sides: a few bytes can claim a picture of gigabytes."""
    problem = f"not a readable picture ({len(payload)} bytes)"
    if payload.startswith(b"\x89PNG\r\n\x1a\n"):
        sides = _png_sides(payload)
    elif payload.startswith(b"\xff\xd8"):
        sides = _jpeg_sides(payload)
    else:
        sides = None
    if sides is None:
        instead = placeholder(payload) or "neither a whole PNG nor a JPEG"
        raise EpisodeError.at(where, f"{problem}: {instead}", kind="undecodable")
    if not 0 < sides[0] * sides[1] <= MAX_PIXELS:
        raise EpisodeError.at(where, f"its header says {sides[0]} × {sides[1]} pixels")
    try:
        picture = cv2.imdecode(np.frombuffer(payload, np.uint8), flags)
    except cv2.error as error:
        raise EpisodeError.at(where, f"{problem}: {error.err}") from error
    if picture is None:
        raise EpisodeError.at(where, problem)
    return picture


def _png_sides(payload: bytes) -> tuple[int, int] | None:
    """Returns a PNG's sides; None if a chunk claims to be longer than the file: OpenCV allocates what it claims."""
    place = 8
    while place + 12 <= len(payload):
        end = place + 12 + int.from_bytes(payload[place : place + 4], "big")
        if end > len(payload):
            return None
        if payload[place + 4 : place + 8] == b"IEND":
            return int.from_bytes(payload[16:20], "big"), int.from_bytes(payload[20:24], "big")
        place = end
    return None


def _jpeg_sides(payload: bytes) -> tuple[int, int] | None:
    """Returns a JPEG's sides from its largest frame header: the decoder would use a second header over the first."""
    largest: tuple[int, int] | None = None
    place = payload.find(b"\xff", 2)
    while 0 <= place < len(payload) - 9:
        marker = payload[place + 1]
        if 0xC0 <= marker <= 0xCF and marker not in _NOT_FRAMES:
            height, width = (int.from_bytes(payload[place + at : place + at + 2], "big") for at in (5, 7))
            largest = max(largest or (0, 0), (width, height), key=lambda sides: sides[0] * sides[1])
        if marker == 0xDA:
            break
        has_length = marker not in (0x00, 0x01, 0xFF) and not 0xD0 <= marker <= 0xD8
        if has_length:
            step = 2 + int.from_bytes(payload[place + 2 : place + 4], "big")
        else:
            step = 1
        place = payload.find(b"\xff", place + step)
    return largest


def _bytes(path: Path) -> bytes:
    try:
        return regular(path).read_bytes()
    except OSError as error:
        raise EpisodeError.at(path, reason(error)) from error


@dataclass(frozen=True)
class Placement:
    """The place of a recorded picture in the square: position x of the picture is ``scale * x + offset`` of the square.

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
        if height == width:
            words = ""
        else:
            words = f"{width} × {height} {_DONE[fit]}"
        if fit == "crop":
            side = min(height, width)
            left = (width - side) // 2
            top = (height - side) // 2
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
            scale = self.scale[axis]
            offset = self.offset[axis]
            source.append(_pixels(-offset / scale, (1 - offset) / scale, side))
            target.append(_pixels(offset, offset + scale, self.size))
        if picture.ndim == 3:
            method = cv2.INTER_AREA
        else:
            method = cv2.INTER_NEAREST_EXACT
        rows, columns = target
        part = picture[tuple(source)]
        small = cv2.resize(part, (columns.stop - columns.start, rows.stop - rows.start), interpolation=method)
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
