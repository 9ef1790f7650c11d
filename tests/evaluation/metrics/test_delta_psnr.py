import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.evaluation.metrics.delta_psnr import action_range, clip_means, delta_psnr, other_clips, uniform_actions


def test_delta_is_the_difference_of_two_psnrs():
    rng = np.random.default_rng(0)
    truth, own, random = rng.integers(0, 256, (3, 2, 5, 6, 6, 3)).astype(np.uint8)
    got = delta_psnr(truth, own, random)
    for b, t in np.ndindex(2, 5):
        own_mse, random_mse = (np.mean((truth[b, t].astype(float) - x[b, t]) ** 2) for x in (own, random))
        np.testing.assert_allclose(got[b, t], 10 * np.log10(random_mse / own_mse), atol=1e-4)


def test_clip_means_leave_the_given_frames_out_and_take_the_fourth_predicted():
    delta = np.zeros((3, 2, 8))
    delta[:, 0] = np.arange(8) + np.array([-1.0, 0.0, 1.0])[:, None]
    delta[:, :, 0] = 1000
    means = clip_means(delta)
    np.testing.assert_allclose(means["mean"], [np.mean(np.arange(1, 8)), 0])
    np.testing.assert_allclose(means["t4"], [4, 0])
    np.testing.assert_allclose(clip_means(delta, prompt_frames=2)["t4"], [5, 0])
    assert "t4" not in clip_means(delta[..., :4])


def test_uniform_actions_fill_the_training_range_and_keep_row_zero():
    rng = np.random.default_rng(0)
    training = rng.normal([0, 5, -1], [1, 0.1, 3], (200, 16, 3)).astype(np.float32)
    training[:, 0] = 777  # row 0 must not enter the range
    low, high = action_range(training)
    np.testing.assert_allclose(low, np.percentile(training[:, 1:].reshape(-1, 3), 1, axis=0))
    clips = training[:5]
    drawn = uniform_actions(clips, low, high, draws=20, seed=1)
    assert drawn.shape == (20, 5, 16, 3)
    assert drawn.dtype == np.float32
    np.testing.assert_array_equal(drawn[:, :, 0], np.broadcast_to(clips[:, 0], (20, 5, 3)))
    moved = drawn[:, :, 1:].reshape(-1, 3)
    assert (moved >= low - 1e-6).all()
    assert (moved <= high + 1e-6).all()
    np.testing.assert_allclose(moved.mean(0), (low + high) / 2, atol=0.05 * (high - low).max())
    np.testing.assert_allclose(np.ptp(moved, axis=0), high - low, rtol=0.02)
    np.testing.assert_array_equal(drawn, uniform_actions(clips, low, high, draws=20, seed=1))
    assert (drawn[0, :, 1:] != drawn[1, :, 1:]).any()


@settings(max_examples=30, deadline=None)
@given(clips=st.integers(2, 30), draws=st.integers(1, 5), seed=st.integers(0, 1000))
def test_no_clip_ever_gets_its_own_actions(clips, draws, seed):
    owners = other_clips(clips, draws, seed)
    assert owners.shape == (draws, clips)
    assert (owners != np.arange(clips)).all()
    assert (np.sort(owners, axis=1) == np.arange(clips)).all()


def test_derangements_are_uniform():
    counts = np.unique(other_clips(4, 9000, seed=0), axis=0, return_counts=True)[1]
    assert len(counts) == 9  # !4
    assert np.abs(counts / 1000 - 1).max() < 0.15


def test_one_clip_has_no_other():
    with pytest.raises(ValueError, match=r"at least 2 clips.*eval\.clips"):
        other_clips(1, 3, 0)
