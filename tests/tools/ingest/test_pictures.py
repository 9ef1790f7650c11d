import contextlib
import resource
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.tools.ingest.episode import MAX_PIXELS, EpisodeError
from rsjax.tools.ingest.pictures import PictureFiles, decode_pictures


def write(path: Path, image: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), image)
    return path


def decoded(payload: bytes, where: str) -> np.ndarray:
    return decode_pictures([(where, payload)])[0]


def test_pictures_are_rgb_in_the_order_asked_for(tmp_path: Path) -> None:
    red, blue = np.zeros((2, 4, 6, 3), np.uint8)
    red[..., 0] = 200
    blue[..., 2] = 100
    paths = [write(tmp_path / f"{n}.png", image[..., ::-1]) for n, image in enumerate((red, blue))]
    frames = PictureFiles(paths)
    assert len(frames) == 2
    np.testing.assert_array_equal(frames.read([1, 0, 1]), [blue, red, blue])


def test_depth_is_in_metres(tmp_path: Path) -> None:
    raw = np.arange(24, dtype=np.uint16).reshape(4, 6) * 100
    frames = PictureFiles([write(tmp_path / "d.png", raw)], depth=True)
    np.testing.assert_allclose(frames.read([0])[0], raw / 1000, rtol=1e-6)


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    gray = write(tmp_path / "gray.png", np.zeros((4, 6), np.uint8))
    wide = write(tmp_path / "wide.png", np.zeros((4, 8), np.uint8))
    for frames, numbers, message in (
        (PictureFiles([gray], depth=True), [0], r"gray.png: uint8 \(4, 6\), a depth map has 16 bits"),
        (PictureFiles([gray, wide]), [0, 1], r"wide.png: pictures of several sizes \(8 × 4 and 6 × 4\)"),
        (PictureFiles([tmp_path / "gone.png"]), [0], "gone.png: missing"),
    ):
        with pytest.raises(EpisodeError, match=message):
            frames.read(numbers)
    black = np.zeros((16, 16, 3), np.uint8)
    others = [cv2.imencode(ending, black)[1].tobytes() for ending in (".bmp", ".tiff", ".webp")]
    for payload in (b"", b"nothing", gray.read_bytes()[:40], *others):
        with pytest.raises(EpisodeError, match=r"^row 7: not a readable picture \(\d+ bytes\)"):
            decoded(payload, "row 7")


def framed(payload: bytes, height: int, width: int) -> bytes:
    """The same JPEG, whose header says other sides."""
    place = payload.index(b"\xff\xc0")
    return payload[: place + 5] + height.to_bytes(2, "big") + width.to_bytes(2, "big") + payload[place + 9 :]


def test_headers_that_claim_enormous_pictures_are_refused_before_memory_is_taken() -> None:
    jpeg = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    png = cv2.imencode(".png", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    assert decoded(framed(jpeg, 16, 16), "p").shape == (16, 16, 3)
    for payload in (framed(jpeg, 40000, 30000), png[:16] + (30000).to_bytes(4, "big") + png[20:]):
        with pytest.raises(EpisodeError, match=r"^p: its header says 30000 × \d+ pixels|^p: not a readable picture"):
            decoded(payload, "p")


def test_chunks_that_claim_to_be_enormous_take_no_memory() -> None:
    png = cv2.imencode(".png", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    place = png.index(b"IDAT") - 4
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(EpisodeError, match="^p: not a readable picture"):
        decoded(png[:place] + (2**30 + 2**29).to_bytes(4, "big") + png[place + 4 :], "p")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**19  # KiB


@settings(max_examples=60)
@given(st.data(), st.sampled_from([".jpg", ".png"]))
def test_a_damaged_picture_is_reported_or_keeps_its_shape(data: st.DataObject, ending: str) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (24, 16, 3), np.uint8)
    payload = bytearray(cv2.imencode(ending, noise)[1].tobytes())
    if data.draw(st.booleans()):
        payload = payload[: data.draw(st.integers(0, len(payload) - 3))]
        with pytest.raises(EpisodeError, match="^p: "):
            decoded(bytes(payload), "p")
        return
    payload[data.draw(st.integers(0, len(payload) - 1))] ^= data.draw(st.integers(1, 255))
    with contextlib.suppress(EpisodeError):
        assert decoded(bytes(payload), "p").size <= 3 * MAX_PIXELS
