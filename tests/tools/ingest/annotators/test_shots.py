import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.tools.ingest.annotators.shots import HistogramShots, histogram_changes, spans_between
from tests.tools.ingest.videos import ArrayFrames, sliding


def scene(count, color):
    noise = np.random.default_rng(color[0]).integers(0, 20, (count, 24, 32, 3))
    return (np.array(color) + noise).astype(np.uint8)


SCENES = [scene(40, (200, 20, 20)), scene(30, (20, 200, 20)), scene(50, (20, 20, 200))]


def test_cuts_between_scenes_are_found_to_the_frame():
    assert HistogramShots()(ArrayFrames(np.concatenate(SCENES))) == [(0, 40), (40, 70), (70, 120)]


def test_motion_within_a_scene_is_no_cut():
    assert HistogramShots()(sliding(40, (3, 1))) == [(0, 40)]


def test_a_slow_fade_is_no_cut():
    share = np.linspace(0, 1, 60)[:, None, None, None]
    faded = (1 - share) * SCENES[0][:1] + share * SCENES[1][:1]
    assert HistogramShots()(ArrayFrames(faded.astype(np.uint8))) == [(0, 60)]


def test_a_flash_is_one_cut_at_most():
    pictures = SCENES[0].copy()
    pictures[20:22] = 255
    assert len(HistogramShots()(ArrayFrames(pictures))) <= 2


@pytest.mark.parametrize("count", [1, 2])
def test_tiny_videos_are_one_shot(count):
    assert HistogramShots()(ArrayFrames(SCENES[0][:count])) == [(0, count)]


def test_changes_are_shares():
    changes = histogram_changes(ArrayFrames(np.concatenate(SCENES)))
    assert changes[0] == 0 and (changes >= 0).all() and (changes <= 1 + 1e-6).all()
    assert changes[40] > 0.9


@given(st.integers(1, 50), st.sets(st.integers(1, 49)))
def test_shots_cover_everything_once(count, cuts):
    spans = spans_between(sorted(cut for cut in cuts if cut < count), count)
    assert [t for start, end in spans for t in range(start, end)] == list(range(count))
