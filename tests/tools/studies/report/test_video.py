import base64
import io

import av
import numpy as np
import pytest
from PIL import Image

from rsjax.clip import GENERATED_MARK
from rsjax.tools.studies.report.video import resize, webp_uri, write_gif, write_mp4

_COLORS = np.array([[200, 40, 40], [40, 180, 60], [40, 60, 200], [220, 220, 220], [20, 20, 20]], np.uint8)


def _flat_frames(height, width):
    return np.broadcast_to(_COLORS[:, None, None], (len(_COLORS), height, width, 3)).copy()


def _decode(uri):
    return Image.open(io.BytesIO(base64.b64decode(uri.split(",", 1)[1])))


@pytest.mark.parametrize(("height", "width", "upscale"), [(32, 48, 1), (17, 15, 3)])
def test_mp4_reads_back_in_order_and_colour(tmp_path, height, width, upscale):
    path = tmp_path / "new" / "clip.mp4"
    frames = _flat_frames(height, width)
    write_mp4(path, frames, fps=5, upscale=upscale, comment=GENERATED_MARK)
    with av.open(path) as container:
        assert container.metadata["comment"] == GENERATED_MARK
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 5)
        read = np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
    assert read.shape == (5, *(-(-side * upscale // 2) * 2 for side in (height, width)), 3)
    np.testing.assert_allclose(read.mean((1, 2)), _COLORS, atol=6)
    assert [p.name for p in path.parent.iterdir()] == ["clip.mp4"]


def test_mp4_keeps_the_picture_upright_and_rgb(tmp_path):
    frame = np.zeros((64, 64, 3), np.uint8)
    frame[:32, :32] = (255, 0, 0)
    frame[32:, 32:] = (0, 0, 255)
    write_mp4(tmp_path / "a.mp4", frame[None], fps=4)
    with av.open(tmp_path / "a.mp4") as container:
        read = next(container.decode(video=0)).to_ndarray(format="rgb24").astype(int)
    np.testing.assert_allclose(read[8, 8], (255, 0, 0), atol=12)
    np.testing.assert_allclose(read[56, 56], (0, 0, 255), atol=12)
    np.testing.assert_allclose(read[8, 56], 0, atol=12)


def test_gif_loops_in_order(tmp_path):
    write_gif(tmp_path / "a.gif", _flat_frames(9, 7), fps=4, upscale=2, comment=GENERATED_MARK)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.info["comment"].decode() == GENERATED_MARK
        assert (image.n_frames, image.size, image.info["loop"]) == (5, (14, 18), 0)
        for t, color in enumerate(_COLORS):
            image.seek(t)
            np.testing.assert_allclose(np.asarray(image.convert("RGB"))[9, 7], color, atol=4)
            assert image.info["duration"] == (1000 if t == 4 else 250)


def test_uris_decode_to_their_images():
    assert webp_uri(_flat_frames(16, 16)[1]).startswith("data:image/webp;base64,")
    np.testing.assert_allclose(np.asarray(_decode(webp_uri(_flat_frames(16, 16)[1])))[8, 8], _COLORS[1], atol=6)


def test_nearest_enlargement_repeats_pixels():
    frames = np.random.default_rng(0).integers(0, 256, (2, 3, 4, 3)).astype(np.uint8)
    np.testing.assert_array_equal(resize(frames, 3, "nearest"), frames.repeat(3, axis=1).repeat(3, axis=2))


@pytest.mark.parametrize(
    ("frames", "fps", "message"),
    [
        (np.zeros((2, 8, 8, 3)), 4, "uint8 frames.*float64"),
        (np.zeros((8, 8, 3), np.uint8), 4, r"\[T, H, W, 3\]"),
        (np.zeros((0, 8, 8, 3), np.uint8), 4, "T ≥ 1"),
        (np.zeros((2, 8, 8, 3), np.uint8), 0, "fps must be positive, not 0"),
    ],
)
def test_bad_frames_leave_no_file(tmp_path, frames, fps, message):
    for write, name in ((write_mp4, "a.mp4"), (write_gif, "a.gif")):
        with pytest.raises(ValueError, match=message):
            write(tmp_path / name, frames, fps)
    assert not list(tmp_path.iterdir())
