"""The probe that tells soft from rigid: it learns what features show, and nothing from features that show nothing."""

from dataclasses import replace

import numpy as np
import pytest

from rsjax.config import ConfigError, SimConfig
from rsjax.tools.studies import softness


def test_the_probe_finds_what_is_there_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    soft = np.arange(90) % 2 == 0
    noise = rng.normal(size=(90, 6))
    shown = noise.copy()
    shown[:, 3] += np.where(soft, 1.5, -1.5)
    assert (softness.predicted(shown, soft, folds=2) == soft).mean() > 0.85
    assert 0.3 < (softness.predicted(noise, soft, folds=2) == soft).mean() < 0.7


def test_pictures_features() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (2, 3, 16, 16, 3), dtype=np.uint8)
    small = softness.shrunk(rgb)
    assert small.shape == (2, 3, 8, 8, 3)
    np.testing.assert_allclose(small[1, 2, 3, 4], rgb[1, 2, 6:8, 8:10].mean((0, 1)) / 255)
    shares = softness.histograms(rgb)
    np.testing.assert_allclose(shares.sum(-1), 1)
    first = (rgb[0, 0] // 64 == 0).all(-1).mean()
    assert shares[0, 0, 0] == pytest.approx(first)
    pooled = softness.pooled(shares)
    np.testing.assert_allclose(pooled[:, :64], shares.mean(1))


def test_episodes_have_the_shape_of_the_clips_and_other_arms_are_refused() -> None:
    sim = SimConfig(frames=7, control_steps=3, image_size=48, recipe=("grasps",), seed=5)
    made = softness.episodes_like(sim, 100)
    assert (made.env, made.clips.frames, made.clips.action_dim) == ("rope", 7, 21)
    assert made.seed != sim.seed and made.recipe == ("expert",)
    with pytest.raises(ConfigError) as refused:
        softness.episodes_like(replace(sim, env="metaworld", camera="near", recipe=("expert",)), 100)
    assert "clips are of Meta-World" in str(refused.value)
    with pytest.raises(ConfigError) as refused:
        softness.episodes_like(sim, 10)
    assert str(refused.value).startswith("--episodes is 10")
