import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.evaluation.metrics.psnr_motion import moved, psnr_where
from rsjax.evaluation.registry import Scene, Unavailable
from tests.evaluation.metrics.scored import per_frame, score


def crossing(frames: int = 5, size: int = 40) -> np.ndarray:
    """A white square of 8 pixels that moves to the right by 8 in every frame, on black; then nothing but black."""
    video = np.zeros((frames, size, size, 3), np.uint8)
    for t in range(frames - 1):
        video[t, 16:24, 8 * t : 8 * t + 8] = 255
    return video


def test_what_has_moved_counts_on_and_what_has_not_does_not() -> None:
    masks = moved(crossing())
    assert masks.shape == (4, 40, 40)
    assert masks[0, 20, 4], "where the square was"
    assert masks[0, 20, 12], "where it is"
    assert not masks[0, 20, 22]
    assert masks[3, 20, 22], "where it has been"
    assert not masks[:, [2, 37]].any()
    assert (masks[1:] >= masks[:-1]).all()
    later = moved(crossing(), prompt_frames=2)
    assert not later[:, 20, 2].any(), "compared with the last prompt frame"
    assert later.shape == (3, 40, 40)


@pytest.mark.parametrize(("change", "counts"), [(10, False), (11, True)])
def test_the_threshold_is_ten_grey_levels(change: int, counts: bool) -> None:
    video = np.full((2, 16, 16, 3), 100, np.uint8)
    video[1] += np.uint8(change)
    assert moved(video).all() == moved(video).any() == counts


def test_psnr_of_masked_pixels_is_its_definition() -> None:
    rng = np.random.default_rng(0)
    truth, made = rng.integers(0, 256, (2, 3, 6, 7, 3)).astype(np.uint8)
    mask = rng.random((3, 6, 7)) < 0.4
    mask[2] = False
    made[1][mask[1]] = truth[1][mask[1]]
    got = psnr_where(truth, made, mask)
    errors = (truth[0].astype(float) - made[0])[mask[0]]
    assert got[0] == pytest.approx(10 * np.log10(255**2 / np.mean(errors**2)))
    assert got[1] == 100, "errors elsewhere do not count"
    assert np.isnan(got[2])


def test_the_score_is_the_mean_over_frames_of_clips_that_move() -> None:
    resting = np.concatenate([crossing()[:1], crossing()[:-1]])  # at first
    truth = np.stack([crossing(), np.zeros_like(crossing()), resting])
    made = np.clip(truth.astype(int) + np.array([10, 40, 20])[:, None, None, None, None], 0, 200).astype(np.uint8)
    scene = Scene(Video(truth), Video(made))
    frames, scores = per_frame("psnr_motion", scene), score("psnr_motion", scene)
    assert np.isnan(frames[1]).all()
    assert np.isfinite(frames[[0, 2]]).sum(1).tolist() == [4, 3]
    np.testing.assert_allclose(scores, np.nanmean(frames[[0, 2]], axis=1))
    repeated = Scene(Video(truth), Video(np.repeat(truth[:, :1], 5, 1)))
    assert np.mean(score("psnr_motion", repeated)) < np.mean(score("psnr", repeated)[""][[0, 2]])
    with pytest.raises(Unavailable, match="nothing moves in the test clips"):
        score("psnr_motion", Scene(Video(truth[1:2]), Video(made[1:2])))
