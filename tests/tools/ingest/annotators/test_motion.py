import numpy as np
import pytest

from rsjax.tools.ingest.annotators.motion import DISFlow, measure_motion
from rsjax.tools.ingest.annotators.protocols import CHUNK
from tests.tools.ingest.videos import ArrayFrames, sliding


def test_flow_is_in_pixels_right_and_down():
    frames = sliding(2, (2, -1), (64, 96)).pictures
    field = DISFlow()(frames[:1], frames[1:])
    np.testing.assert_allclose(field[0, 16:-16, 16:-16].mean((0, 1)), [2, -1], atol=0.2)


@pytest.mark.parametrize("size", [(96, 128), (288, 384)])
def test_motion_is_in_pixels_a_second_of_a_picture_256_wide(size):
    scale = size[1] // 128
    frames = sliding(4, (2 * scale, 0), size)
    motion = measure_motion(frames, np.arange(4) / 5, DISFlow())
    assert motion.mean[0] == motion.high[0] == 0
    np.testing.assert_allclose(motion.mean[1:], 2 * 2 * 5, rtol=0.2)


def test_a_small_thing_shows_in_high_and_hardly_in_mean():
    frames = sliding(2, (0, 0), (192, 256)).pictures.copy()
    frames[:, 60:116, 40:160] = sliding(2, (3, 0), (56, 120), seed=3).pictures
    motion = measure_motion(ArrayFrames(frames), np.arange(2.0), DISFlow())
    assert motion.high[1] > 2 > 1 > motion.mean[1]


def test_still_pictures_do_not_move_and_time_gaps_count():
    frames = sliding(3, (2, 0), (96, 128))
    motion = measure_motion(frames, np.array([0.0, 0.1, 0.3]), DISFlow())
    assert motion.mean[1] == pytest.approx(2 * motion.mean[2], rel=0.2)
    still = measure_motion(sliding(3, (0, 0)), np.arange(3.0), DISFlow())
    assert still.high.max() < 0.1


def test_every_frame_is_measured_across_chunks():
    class Counting:
        name = "counting"
        version = 1

        def __call__(self, before, after):
            step = (after - before).astype(np.float32)[..., :1]
            return np.concatenate([step, np.zeros_like(step)], -1)

    count = 2 * CHUNK + 3
    levels = np.cumsum(np.arange(count) % 3).astype(np.uint8)
    pictures = np.broadcast_to(levels[:, None, None, None], (count, 32, 256, 3))
    motion = measure_motion(ArrayFrames(pictures), np.arange(count, dtype=float), Counting())
    np.testing.assert_allclose(motion.mean, np.arange(count) % 3)
