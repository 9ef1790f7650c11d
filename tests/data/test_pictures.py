from pathlib import Path

import cv2
import numpy as np
import pytest

from rsjax.data.episode import EpisodeError
from rsjax.data.pictures import DepthFiles, PictureFiles, decode_picture


def write(path: Path, image: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), image)
    return path


def test_pictures_are_rgb_in_the_order_asked_for(tmp_path: Path) -> None:
    red, blue = np.zeros((2, 4, 6, 3), np.uint8)
    red[..., 0], blue[..., 2] = 200, 100
    paths = [write(tmp_path / f"{n}.png", image[..., ::-1]) for n, image in enumerate((red, blue))]
    frames = PictureFiles(paths)
    assert len(frames) == 2
    np.testing.assert_array_equal(frames.read([1, 0, 1]), [blue, red, blue])


def test_depth_is_in_metres(tmp_path: Path) -> None:
    raw = np.arange(24, dtype=np.uint16).reshape(4, 6) * 100
    frames = DepthFiles([write(tmp_path / "d.png", raw)], unit=0.001)
    np.testing.assert_allclose(frames.read([0])[0], raw / 1000, rtol=1e-6)


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    gray = write(tmp_path / "gray.png", np.zeros((4, 6), np.uint8))
    wide = write(tmp_path / "wide.png", np.zeros((4, 8), np.uint8))
    with pytest.raises(EpisodeError, match=r"gray.png: uint8 \(4, 6\), a depth map has 16 bits"):
        DepthFiles([gray]).read([0])
    with pytest.raises(EpisodeError, match=r"wide.png: \(4, 8\) pixels, gray.png has \(4, 6\)"):
        PictureFiles([gray, wide]).read([0, 1])
    with pytest.raises(EpisodeError, match=r"gone.png: cannot be read \(No such file"):
        PictureFiles([tmp_path / "gone.png"]).read([0])
    for payload in (b"", b"nothing", gray.read_bytes()[:40]):
        with pytest.raises(EpisodeError, match=r"^row 7: not a readable picture \(\d+ bytes\)"):
            decode_picture(payload, "row 7")
