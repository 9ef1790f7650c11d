"""Frames to MP4, GIF, PNG and animated WebP files or data URIs, and depth to colours for the eye."""

import base64
import io
from fractions import Fraction
from pathlib import Path
from typing import Literal

import av
import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from rsjax.files import write_atomically

Resample = Literal["nearest", "bicubic"]

_FILTERS = {"nearest": Image.Resampling.NEAREST, "bicubic": Image.Resampling.BICUBIC}
_HOLD = 4  # the last frame of a looping animation stays this many times longer
_TURBO = np.round(matplotlib.colormaps["turbo"](np.linspace(1, 0, 256))[:, :3] * 255).astype(np.uint8)


def write_mp4(
    path: Path | str, frames: UInt8[np.ndarray, "T H W 3"], fps: float, upscale: int = 1, crf: int = 16
) -> None:
    """Write an H.264 (yuv420p) video that browsers and players open.

    Args:
        path: ends in .mp4; its folder is made if missing. The file appears only when it is whole.
        frames: 0–255, RGB. Odd sides gain one repeated row or column, since yuv420p wants even ones.
        fps: frames per second, > 0.
        upscale: every pixel becomes a square of this side.
        crf: H.264's constant rate factor: 0 is lossless, 23 its default.

    Raises:
        ValueError: frames of another shape or dtype, no frames, or a frame rate that is not positive.
    """
    _check(frames, fps)
    frames = resize(frames, upscale, "nearest")
    height, width = frames.shape[1:3]
    frames = np.pad(frames, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000), options={"crf": str(crf)})
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    write_file(path, buffer.getvalue())


def write_gif(path: Path | str, frames: UInt8[np.ndarray, "T H W 3"], fps: float, upscale: int = 1) -> None:
    """Write a GIF that loops and holds its last frame a little; arguments and errors as :func:`write_mp4`."""
    _check(frames, fps)
    write_file(path, _encode_animation("GIF", resize(frames, upscale, "nearest"), fps))


def write_file(path: Path | str, payload: bytes) -> None:
    """Write a file that is whole or not there; missing parent folders are made."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, payload)


def png_uri(image: UInt8[np.ndarray, "H W 3"]) -> str:
    """An RGB picture as a ``data:image/png`` URI, lossless."""
    return _image_uri(image, "PNG", optimize=True)


def webp_uri(image: UInt8[np.ndarray, "H W 3"], quality: int = 90) -> str:
    """An RGB picture as a ``data:image/webp`` URI, lossy: about a tenth of the PNG."""
    return _image_uri(image, "WEBP", quality=quality)


def animation_uri(frames: UInt8[np.ndarray, "T H W 3"], fps: float, quality: int = 85) -> str:
    """Frames as a looping ``data:image/webp`` URI; the last frame is held a little.

    Raises:
        ValueError: as :func:`write_mp4`.
    """
    _check(frames, fps)
    return _data_uri("image/webp", _encode_animation("WEBP", frames, fps, quality=quality, method=4))


def resize(frames: UInt8[np.ndarray, "T H W 3"], scale: int, resample: Resample) -> UInt8[np.ndarray, "T sH sW 3"]:
    """Frames enlarged by a whole number."""
    if scale == 1:
        return frames
    height, width = (side * scale for side in frames.shape[1:3])
    return np.stack([np.asarray(Image.fromarray(f).resize((width, height), _FILTERS[resample])) for f in frames])


def depth_to_colors(depth: Float[np.ndarray, "..."], near: float, far: float) -> UInt8[np.ndarray, "... 3"]:
    """Depth in metres as colours: ``near`` and closer is red, ``far`` and farther is violet (the turbo map).

    Even steps of colour are even steps of 1/depth, so that what lies close is told apart well. Unknown (not a number)
    counts as far. For looking at only; the colours that the tokenizer sees are :mod:`rsjax.data.depth_color`'s.

    Raises:
        ValueError: not 0 < ``near`` < ``far``.
    """
    if not 0 < near < far:
        raise ValueError(f"depth colours need 0 < near < far, not near = {near} m and far = {far} m")
    share = (1 / near - 1 / np.clip(np.nan_to_num(depth, nan=far), near, far)) / (1 / near - 1 / far)
    return _TURBO[np.round(share * 255).astype(np.uint8)]


def _check(frames: UInt8[np.ndarray, "T H W 3"], fps: float) -> None:
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8 or not frames.size:
        raise ValueError(f"a video needs uint8 frames [T, H, W, 3] with T ≥ 1, not {frames.dtype} {frames.shape}")
    if not fps > 0:
        raise ValueError(f"a video's fps must be positive, not {fps}")


def _encode_animation(kind: str, frames: UInt8[np.ndarray, "T H W 3"], fps: float, **options: int) -> bytes:
    milliseconds = round(1000 / fps)
    durations = [milliseconds] * (len(frames) - 1) + [milliseconds * _HOLD]
    first, *rest = [Image.fromarray(frame) for frame in frames]
    buffer = io.BytesIO()
    first.save(buffer, kind, save_all=True, append_images=rest, duration=durations, loop=0, **options)
    return buffer.getvalue()


def _image_uri(image: UInt8[np.ndarray, "H W 3"], kind: str, **options: int) -> str:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, kind, **options)
    return _data_uri(f"image/{kind.lower()}", buffer.getvalue())


def _data_uri(mime: str, data: bytes) -> str:
    return f"data:{mime};base64,{base64.b64encode(data).decode()}"
