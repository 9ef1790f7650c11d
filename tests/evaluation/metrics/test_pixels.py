import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.clip import Video
from rsjax.evaluation.metrics.psnr import PSNR_CAP, psnr
from rsjax.evaluation.metrics.ssim import ssim
from rsjax.evaluation.registry import Scene, Unavailable
from tests.evaluation.metrics import scored


def _pair(seed, shape=(2, 3, 14, 17, 3), noise=30):
    rng = np.random.default_rng(seed)
    truth = rng.integers(0, 256, shape)
    noisy = np.clip(truth + rng.normal(0, noise, shape), 0, 255)
    return truth.astype(np.uint8), noisy.astype(np.uint8)


def _ssim_by_loop(x, y):
    """One channel, window by window, variances as weighted squared deviations."""
    offsets = np.arange(11) - 5
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    values = []
    for i in range(x.shape[0] - 10):
        for j in range(x.shape[1] - 10):
            a, b = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
            mean_a, mean_b = (window * a).sum(), (window * b).sum()
            var_a, var_b = (window * (a - mean_a) ** 2).sum(), (window * (b - mean_b) ** 2).sum()
            cov = (window * (a - mean_a) * (b - mean_b)).sum()
            c1, c2 = 2.55**2, 7.65**2
            luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
            values.append(luminance * (2 * cov + c2) / (var_a + var_b + c2))
    return np.mean(values)


def test_psnr_is_its_definition_frame_by_frame():
    truth, noisy = _pair(0)
    got = psnr(truth, noisy)
    assert got.shape == (2, 3)
    for b in range(2):
        for t in range(3):
            mse = np.mean((truth[b, t].astype(float) - noisy[b, t].astype(float)) ** 2)
            np.testing.assert_allclose(got[b, t], 10 * np.log10(255**2 / mse), rtol=1e-5)


def test_ssim_is_its_definition_window_by_window():
    truth, noisy = _pair(1)
    got = ssim(truth, noisy)
    assert got.shape == (2, 3)
    for b, t in np.ndindex(2, 3):
        x, y = truth[b, t].astype(float), noisy[b, t].astype(float)
        expected = np.mean([_ssim_by_loop(x[..., c], y[..., c]) for c in range(3)])
        np.testing.assert_allclose(got[b, t], expected, atol=2e-5)


def test_ssim_holds_on_flat_bright_frames():
    """Where the variances vanish only the luminance term is left; float32 must not invent contrast."""
    x, y = np.full((16, 16, 3), 250, np.uint8), np.full((16, 16, 3), 200, np.uint8)
    c1 = 2.55**2
    np.testing.assert_allclose(ssim(x, y), (2 * 250 * 200 + c1) / (250**2 + 200**2 + c1), atol=1e-3)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), noise=st.floats(1, 100))
def test_scores_are_symmetric_and_perfect_only_on_equal_frames(seed, noise):
    truth, noisy = _pair(seed, (12, 12, 3), noise)
    for score, best in ((psnr, PSNR_CAP), (ssim, 1.0)):
        np.testing.assert_allclose(score(truth, noisy), score(noisy, truth), rtol=1e-4)
        np.testing.assert_allclose(score(truth, truth), best, rtol=1e-5)
        assert score(truth, noisy) < best


def test_bad_shapes_are_named():
    with pytest.raises(ValueError, match=r"\(4, 4, 3\) and \(4, 5, 3\)"):
        psnr(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
    with pytest.raises(ValueError, match="at least 11×11"):
        ssim(np.zeros((10, 64, 3)), np.zeros((10, 64, 3)))


def test_frames_smaller_than_the_window_have_no_ssim():
    small = Video(np.zeros((1, 3, 16, 10, 3), np.uint8))
    for result in (scored.score, scored.per_frame):
        with pytest.raises(Unavailable, match="frames of 10 pixels; SSIM takes windows of 11"):
            result("ssim", Scene(small, small))
