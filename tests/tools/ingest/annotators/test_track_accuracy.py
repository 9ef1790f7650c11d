import numpy as np
import pytest

from rsjax.clip import Clip
from rsjax.data.store import encode_clip, write_store
from rsjax.tools.ingest.annotators.tracks import LucasKanade, grid_points
from tests.tools.ingest.annotators import track_accuracy as accuracy
from tests.tools.ingest.videos import sliding


def sliding_clip(step):
    frames = sliding(5, step).pictures
    points = grid_points(6, np.zeros((0, 2)))
    tracks = points[:, None] + np.arange(5)[None, :, None] * np.array(step) / [64, 48]
    return Clip(
        rgb=frames,
        depth=np.full((5, 48, 64), 1.5, np.float32),
        actions=np.zeros((5, 2), np.float32),
        tracks=tracks.astype(np.float32),
        visible=((tracks >= 0) & (tracks < 1)).all(-1),
        success=np.zeros(5, bool),
        task="",
    )


def shifted(pixels):
    """Follows every point exactly, but that many pixels too far right; the first of them not at all."""

    def follow(pictures, points, depth):
        places = clip.tracks + np.array([pixels / 64, 0], np.float32)
        seen = np.ones(places.shape[:2], bool)
        seen[0, 1:] = False
        return places, seen

    clip = sliding_clip((2, 0))
    return clip, follow


def test_a_known_error_is_measured():
    clip, follow = shifted(1.5)
    found = accuracy.track_accuracy([clip, clip], follow)
    assert found.median == pytest.approx(1.5, abs=1e-3)
    assert found.within == (0.0, 1.0, 1.0)
    assert found.followed == pytest.approx(1 - 8 / (2 * clip.visible[:, 1:].sum()))
    assert found.false == pytest.approx(1 - clip.visible[1:, 1:].mean())


def test_points_that_have_not_moved_can_be_left_out():
    still = sliding_clip((0, 0))
    moving = sliding_clip((2, 0))
    both = accuracy.track_accuracy([still, moving], LucasKanade().follow)
    some = accuracy.track_accuracy([still, moving], LucasKanade().follow, moving_only=True)
    alone = accuracy.track_accuracy([moving], LucasKanade().follow)
    assert some == alone and both.places > some.places


def test_single_steps_begin_at_the_truth():
    clip = sliding_clip((2, 0))
    steps = list(accuracy.single_steps(clip))
    assert len(steps) == 4 and all(step.visible[:, 0].all() for step in steps)
    np.testing.assert_array_equal(steps[3].tracks[:, 1], clip.tracks[clip.visible[:, 3], 4])
    np.testing.assert_array_equal(steps[3].rgb, clip.rgb[3:])


@pytest.mark.parametrize("scale", ["linear", "inverse"])
def test_colours_keep_depth_to_half_a_level(scale):
    clip = sliding_clip((0, 0))
    clip.depth[:] = np.linspace(0.5, 2.5, clip.depth.size).reshape(clip.depth.shape)
    mean, greatest, _ = accuracy.color_round_trip([clip], 0.5, 2.5, scale)
    level = 2 / 765 if scale == "linear" else (1 / 0.5 - 1 / 2.5) / 765 * 2.5**2
    assert 0 < mean < greatest <= level / 2 * 1.01


def test_the_command_prints_both(tmp_path, capsys):
    write_store(tmp_path / "s", "clips", {"test": [encode_clip(sliding_clip((2, 0)))]}, {"depth_range": [0.5, 2.5]})
    accuracy.main([str(tmp_path / "s")])
    printed = capsys.readouterr().out
    assert "whole clips, moving points: median 0." in printed and "depth colours, inverse" in printed
