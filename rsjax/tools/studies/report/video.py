"""Encodes frames as MP4 and GIF files and WebP data URIs."""

import base64
import io
import math
from fractions import Fraction
from pathlib import Path
from typing import Literal

import av
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from rsjax.files import write_file

Resample = Literal["nearest", "bicubic"]

_FILTERS = {"nearest": Image.Resampling.NEAREST, "bicubic": Image.Resampling.BICUBIC}
_HOLD = 4  # a GIF's last frame lasts this many times as long as the others
_CRF = 16


def write_mp4(
    path: Path, frames: UInt8[np.ndarray, "T H W 3"], fps: float, upscale: int = 1, comment: str = ""
) -> None:
    """Writes an H.264 (yuv420p) video that browsers and players can open.

    Args:
        path: ends in .mp4. The file is written atomically, and its parent directories are made.
        frames: 0–255, RGB. If a side is odd, its last row or column is repeated, since yuv420p needs even sides.
        fps: frames per second, above 0.
        upscale: side of the square of pixels that each pixel becomes.
        comment: of the file's metadata, such as :data:`rsjax.clip.GENERATED_MARK`.

    Raises:
        ValueError: the frames have another shape or dtype, there are none, or the frame rate is not positive.
    """
    _check(frames, fps)
    write_file(path, mp4(resize(frames, upscale, "nearest"), fps, comment=comment))


def mp4(frames: UInt8[np.ndarray, "T H W 3"], fps: float, crf: int = _CRF, comment: str = "") -> bytes:
    """Returns frames as the content of an H.264 (yuv420p) file. Arguments as in :func:`write_mp4`.

    Args:
        crf: constant rate factor: 0 is lossless, 23 the encoder's default.
    """
    height, width = frames.shape[1:3]
    frames = np.pad(frames, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        if comment:
            container.metadata["comment"] = comment
        rate = Fraction(fps).limit_denominator(1000)
        stream = container.add_stream("libx264", rate=rate, options={"crf": str(crf)})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return buffer.getvalue()


def write_gif(
    path: Path, frames: UInt8[np.ndarray, "T H W 3"], fps: float, upscale: int = 1, comment: str = ""
) -> None:
    """Writes a GIF that loops and shows its last frame longer. Arguments and errors as in :func:`write_mp4`."""
    _check(frames, fps)
    milliseconds = round(1000 / fps)
    durations = [milliseconds] * (len(frames) - 1) + [milliseconds * _HOLD]
    first, *rest = [Image.fromarray(frame) for frame in resize(frames, upscale, "nearest")]
    buffer = io.BytesIO()
    first.save(buffer, "GIF", save_all=True, append_images=rest, duration=durations, loop=0, comment=comment.encode())
    write_file(path, buffer.getvalue())


def webp_uri(image: UInt8[np.ndarray, "H W 3"], quality: int = 90) -> str:
    """Returns an RGB image as a lossy ``data:image/webp`` URI, about a tenth the size of a PNG."""
    return f"data:image/webp;base64,{base64.b64encode(webp(image, quality)).decode()}"


def webp(image: UInt8[np.ndarray, "H W 3"], quality: int = 90) -> bytes:
    """Returns an RGB image as the content of a lossy WebP file."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "WEBP", quality=quality)
    return buffer.getvalue()


def sprite_uri(frames: UInt8[np.ndarray, "T H W 3"]) -> str:
    """Returns frames as one ``data:image/webp`` URI: tiles in a near-square, row by row; unused tiles are black."""
    count, height, width, _ = frames.shape
    columns = math.ceil(math.sqrt(count))
    lines = -(-count // columns)
    tiles = np.zeros((lines * columns, height, width, 3), np.uint8)
    tiles[:count] = frames
    sheet = tiles.reshape(lines, columns, height, width, 3).swapaxes(1, 2)
    return webp_uri(sheet.reshape(lines * height, columns * width, 3), quality=95)


def resize(
    frames: UInt8[np.ndarray, "T H W 3"], scale: int, resample: Resample = "bicubic"
) -> UInt8[np.ndarray, "T sH sW 3"]:
    """Enlarges frames by a whole factor."""
    if scale == 1:
        return frames
    height, width = (side * scale for side in frames.shape[1:3])
    return np.stack([np.asarray(Image.fromarray(f).resize((width, height), _FILTERS[resample])) for f in frames])


def _check(frames: UInt8[np.ndarray, "T H W 3"], fps: float) -> None:
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or not frames.size:
        raise ValueError(f"a video needs uint8 frames [T, H, W, 3] with T ≥ 1, not {frames.dtype} {frames.shape}")
    if not fps > 0:
        raise ValueError(f"a video's fps must be positive, not {fps}")
