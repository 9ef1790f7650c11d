"""Pictures and depth maps that lie on disk one by one, behind the same interface as a video's."""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.ingest.episode import MAX_PIXELS, EpisodeError

_CURE = "fetch the file again or leave the episode out"
_NO_FRAME = (0xC4, 0xC8, 0xCC)  # JPEG markers between those of frame headers: tables


class PictureFiles:
    """One PNG or JPEG file per frame, as :class:`rsjax.ingest.episode.Frames`.

    Args:
        paths: each frame's file.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = list(paths)

    def __len__(self) -> int:
        return len(self._paths)

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        """These pictures; :class:`EpisodeError` names one that is missing, damaged or of another size."""
        return _stacked([self._paths[index] for index in indices], lambda path: decode_picture(_bytes(path), path))


class DepthFiles:
    """One 16-bit PNG file per frame, as :class:`rsjax.ingest.episode.Depths`.

    Args:
        paths: each frame's file.
        unit: metres that a value of 1 stands for.
    """

    def __init__(self, paths: Sequence[Path], unit: float = 0.001) -> None:
        self._paths, self._unit = list(paths), unit

    def __len__(self) -> int:
        return len(self._paths)

    def read(self, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
        """These maps in metres, 0 where nothing was measured; :class:`EpisodeError` as :class:`PictureFiles`."""
        return _stacked([self._paths[index] for index in indices], self._depth)

    def _depth(self, path: Path) -> Float32[np.ndarray, "H W"]:
        raw = _decode(_bytes(path), cv2.IMREAD_UNCHANGED, path)
        if raw.dtype != np.uint16 or raw.ndim != 2:
            raise EpisodeError(f"{path}: {raw.dtype} {raw.shape}, a depth map has 16 bits and one channel; {_CURE}")
        return raw.astype(np.float32) * np.float32(self._unit)


def decode_picture(payload: bytes, where: Path | str) -> UInt8[np.ndarray, "H W 3"]:
    """An encoded picture (PNG or JPEG) as RGB, turned as its EXIF data says.

    Args:
        where: what a message names.

    Raises:
        EpisodeError: it is damaged, neither PNG nor JPEG, or its sides are impossible.
    """
    return _decode(payload, cv2.IMREAD_COLOR, where)[..., ::-1].copy()


def _decode(payload: bytes, flags: int, where: Path | str) -> np.ndarray:
    sides = _sides(payload)
    if sides is None:
        told = f"{where}: not a readable picture ({len(payload)} bytes): neither a whole PNG nor a JPEG; {_CURE}"
        raise EpisodeError(told, "undecodable")
    if not 0 < sides[0] * sides[1] <= MAX_PIXELS:
        raise EpisodeError(f"{where}: its header says {sides[0]} × {sides[1]} pixels; {_CURE}")
    try:
        picture = cv2.imdecode(np.frombuffer(payload, np.uint8), flags)
    except cv2.error as error:
        raise EpisodeError(f"{where}: not a readable picture ({error.err}); {_CURE}") from error
    if picture is None:
        raise EpisodeError(f"{where}: not a readable picture ({len(payload)} bytes); {_CURE}")
    return picture


def _sides(payload: bytes) -> tuple[int, int] | None:
    """Width and height of a PNG or JPEG, before memory is taken for it: a few bytes can name a picture of gigabytes."""
    if payload.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png_sides(payload)
    return _jpeg_sides(payload) if payload.startswith(b"\xff\xd8") else None


def _png_sides(payload: bytes) -> tuple[int, int] | None:
    """None where a chunk is longer than the file: OpenCV takes as much memory as a chunk says that it is long."""
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
    """Those of the largest frame header: a second one would be decoded in place of the first."""
    most: tuple[int, int] | None = None
    place = payload.find(b"\xff", 2)
    while 0 <= place < len(payload) - 9:
        marker = payload[place + 1]
        if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME:
            height, width = (int.from_bytes(payload[place + at : place + at + 2], "big") for at in (5, 7))
            most = max(most or (0, 0), (width, height), key=lambda sides: sides[0] * sides[1])
        if marker == 0xDA:
            break
        has_length = marker not in (0x00, 0x01, 0xFF) and not 0xD0 <= marker <= 0xD8
        step = 2 + int.from_bytes(payload[place + 2 : place + 4], "big") if has_length else 1
        place = payload.find(b"\xff", place + step)
    return most


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise EpisodeError(f"{path}: cannot be read ({error.strerror}); {_CURE}") from error


def _stacked(paths: list[Path], decode: Callable[[Path], np.ndarray]) -> np.ndarray:
    if not paths:
        raise ValueError("no frames asked for")
    pictures: list[np.ndarray] = []
    for path in paths:
        pictures.append(decode(path))
        if pictures[-1].shape != pictures[0].shape:
            raise EpisodeError(f"{path}: {pictures[-1].shape[:2]} pixels, {paths[0].name} has {pictures[0].shape[:2]}")
    return np.stack(pictures)
