"""Videos whose pictures say their number, for the tests of formats."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from rsjax.tools.ingest import video

SIZE = (32, 32)
_OPTIONS = {"libsvtav1": {"preset": "12", "crf": "10"}, "libx264": {"crf": "1"}}


def close_videos() -> None:
    """Closes the videos that this process keeps open."""
    while video._decoders:
        video._decoders.popitem()[1].close()


def picture(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Grey that tells ``number`` (0 … 40), with a white upper left corner."""
    image = np.full((*size, 3), 15 + 5 * number, np.uint8)
    image[: size[0] // 4, : size[1] // 4] = 255
    return image


def write_video(
    path: Path,
    numbers: range,
    fps: float = 30,
    codec: str = "libx264",
    size: tuple[int, int] = SIZE,
    rotation: int = 0,
) -> Path:
    """An MP4 of these pictures with a key frame every 5; its folder is made."""
    return write_pictures(path, [picture(number, size) for number in numbers], fps, codec, rotation)


def write_pictures(
    path: Path, pictures: Sequence[np.ndarray], fps: float = 30, codec: str = "libx264", rotation: int = 0
) -> Path:
    """Any pictures (H, W, 3), as :func:`write_video` writes its own."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format="mp4") as container:
        stream: Any = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1000), options=_OPTIONS[codec])
        stream.height, stream.width, stream.pix_fmt = *pictures[0].shape[:2], "yuv420p"
        stream.codec_context.gop_size = 5
        if rotation:
            stream.set_display_rotation(rotation)
        for image in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return path


def numbers_of(pictures: np.ndarray) -> list[int]:
    """Which pictures these are, checked to be upright."""
    assert (pictures[:, 0, 0].astype(int) - pictures[:, -1, -1] > 0).all()
    middle = pictures[:, pictures.shape[1] // 2 :, pictures.shape[2] // 2 :].mean((1, 2, 3))
    return np.rint((middle - 15) / 5).astype(int).tolist()
