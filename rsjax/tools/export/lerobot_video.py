"""Encodes the videos of a LeRobotDataset."""

import os
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import av
import numpy as np
from jaxtyping import UInt8

ENCODERS = {"av1": "libsvtav1", "h264": "libx264"}
KEY_FRAMES = 2  # frames from one key frame to the next: LeRobot's choice, as training reads frames in random order


def video_rate(fps: float) -> Fraction:
    """Returns the nearest frame rate that a video file can state: a fraction with a denominator of at most 1001."""
    return Fraction(fps).limit_denominator(1001)


@dataclass(frozen=True)
class VideoSettings:
    """Settings of all videos of a data set: codec, constant rate factor, frames per second, pixels along each side."""

    codec: Literal["av1", "h264"]
    crf: int
    fps: float
    size: int

    @property
    def number(self) -> float:
        """Returns the frame rate as ``info.json`` states it: an int if it is a whole number."""
        return int(self.fps) if self.fps == int(self.fps) else self.fps

    def describe(self) -> dict[str, Any]:
        """Returns the ``info`` of a video feature."""
        return {
            "video.height": self.size,
            "video.width": self.size,
            "video.codec": self.codec,
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": self.number,
            "video.channels": 3,
            "has_audio": False,
        }


class VideoFile:
    """A video to which episodes are appended; :meth:`close` completes it."""

    def __init__(self, path: Path, settings: VideoSettings) -> None:
        os.environ.setdefault("SVT_LOG", "1")  # errors only
        path.parent.mkdir(parents=True, exist_ok=True)
        self.frames = self.bytes = 0
        self._container = av.open(str(path), "w", format="mp4")
        options = {"crf": str(settings.crf), "g": str(KEY_FRAMES)}
        rate = video_rate(settings.fps)
        stream: Any = self._container.add_stream(ENCODERS[settings.codec], rate=rate, options=options)
        stream.height = stream.width = settings.size
        stream.pix_fmt = "yuv420p"
        self._stream = stream

    def add(self, rgb: UInt8[np.ndarray, "T H W 3"]) -> None:
        """Appends frames."""
        for frame in rgb:
            self._mux(self._stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        self.frames += len(rgb)

    def close(self) -> None:
        """Writes the frames that the encoder still holds, and the file's index."""
        self._mux(self._stream.encode())
        self._container.close()

    def _mux(self, packets: Any) -> None:
        self.bytes += sum(packet.size for packet in packets)
        self._container.mux(packets)
