import contextlib
import resource
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from rsjax.tools.ingest.episode import MAX_PIXELS, EpisodeError
from rsjax.tools.ingest.pictures import Fit, PictureFiles, Placement, decode_pictures

FITS: list[Fit] = ["crop", "pad", "stretch"]
SIZE = 64


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


@settings(max_examples=40)
@given(st.sampled_from(FITS), st.integers(40, 200), st.integers(40, 200), st.floats(0.2, 0.8), st.floats(0.2, 0.8))
@example("crop", 40, 47, 0.5, 0.5)  # an odd width, of which the depth camera has half, rounded down
def test_a_spot_its_depth_and_its_track_stay_in_one_place(
    fit: Fit, height: int, width: int, x: float, y: float
) -> None:
    """The depth camera has half the resolution of the other."""
    row = int(y * height) // 2 * 2
    column = int(x * width) // 2 * 2
    picture = np.zeros((height, width, 3), np.uint8)
    cv2.circle(picture, (column, row), 6, (255, 255, 255), -1)
    depth = np.ones((height // 2, width // 2), np.float32)
    cv2.circle(depth, (column // 2, row // 2), 3, 2.0, -1)
    placement = Placement.create(fit, height, width, SIZE)
    point = np.array([[[(column + 0.5) / width, (row + 0.5) / height]]])
    (track,), (visible,) = placement.tracks(point, np.ones((1, 1), bool))
    bright = placement.picture(picture)[..., 0]
    far = placement.picture(depth)
    assert bright.shape == far.shape == (SIZE, SIZE)
    if not ((track > 0.15) & (track < 0.85)).all():
        return  # the spot is cut off, or too near to the edge to have its middle there
    assert visible.all()
    coarsest = SIZE / (min(height, width) // 2)  # a pixel of the depth camera, in those of the result
    for weights in (bright, far == 2):
        middle = np.array([np.average(axis, weights=weights) for axis in np.indices(weights.shape)[::-1]])
        np.testing.assert_allclose((middle + 0.5) / SIZE, track[0], atol=max(2.5, coarsest) / SIZE)


@settings(max_examples=40)
@given(st.integers(1, 300), st.integers(1, 300), st.integers(8, 64))
def test_a_crop_is_the_middle_square_and_hides_points_outside_it(height: int, width: int, size: int) -> None:
    assume(height != width)
    picture = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    side = min(height, width)
    top = (height - side) // 2
    left = (width - side) // 2
    placement = Placement.create("crop", height, width, size)
    middle = picture[top : top + side, left : left + side]
    np.testing.assert_array_equal(placement.picture(picture), cv2.resize(middle, (size, size), None, 0, 0, 3))
    ends = np.array([[left + side / 4, top + side / 2], [left - 1, top - 1], [left + side + 1, top + side + 1]])
    points, visible = placement.tracks((ends / [width, height])[:, None], np.ones((3, 1), bool))
    np.testing.assert_allclose(points[0, 0], [0.25, 0.5], atol=1e-6)
    assert visible[:, 0].tolist() == [True, False, False]


@settings(max_examples=40)
@given(st.integers(8, 300), st.integers(8, 300), st.integers(8, 64))
def test_bars_are_black_and_have_no_depth(height: int, width: int, size: int) -> None:
    placement = Placement.create("pad", height, width, size)
    depth = placement.picture(np.ones((height, width), np.float32))
    rgb = placement.picture(np.full((height, width, 3), 9, np.uint8))
    np.testing.assert_array_equal(depth > 0, (rgb == 9).all(-1))
    wide = max(1, round(size * width / max(height, width))), max(1, round(size * height / max(height, width)))
    assert (depth > 0).sum() == wide[0] * wide[1]
    points = np.array([[[0.0, 0.0], [1.0, 1.0]]])
    placed, visible = placement.tracks(points, np.ones((1, 2), bool))
    assert visible.all() and ((placed >= 0) & (placed <= 1 + 1e-6)).all()
    seen = np.argwhere(depth > 0)
    np.testing.assert_allclose(placed[0, :, ::-1] * size, [seen.min(0), seen.max(0) + 1], atol=1e-4)


@pytest.mark.parametrize("fit", FITS)
def test_square_pictures_are_only_shrunk(fit: Fit) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (48, 48, 3), np.uint8)
    placement = Placement.create(fit, 48, 48, 16)
    expected = cv2.resize(picture, (16, 16), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(placement.picture(picture), expected)
    points = np.array([[[0.3, 1.2]]], np.float32)
    seen = np.array([[True]])
    np.testing.assert_array_equal(placement.tracks(points, seen)[0], points)
    assert placement.tracks(points, seen)[1].all() and placement.words == ""
