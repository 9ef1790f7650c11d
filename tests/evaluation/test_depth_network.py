"""The depth network on pictures whose colours tell their depth."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.evaluation.depth_network import DepthNetwork, loss, train_depth_network, varied
from rsjax.evaluation.metrics.depth import depth_scores

SIDE, FRAMES = 16, 4


def clip(seed: int) -> dict[str, Any]:
    """A near red square before a far blue wall."""
    rng = np.random.default_rng(seed)
    rgb = np.full((FRAMES, SIDE, SIDE, 3), (20, 40, 220), np.uint8)
    depth = np.full((FRAMES, SIDE, SIDE), 2.0, np.float32)
    for frame, z, (x, y) in zip(rgb, depth, rng.integers(0, SIDE - 6, (FRAMES, 2)), strict=True):
        frame[y : y + 6, x : x + 6] = (230, 30, 20)
        z[y : y + 6, x : x + 6] = 0.5
    return {"rgb": rgb, "depth": depth}


@pytest.fixture(scope="module")
def network() -> DepthNetwork:
    return train_depth_network([clip(seed) for seed in range(40)], steps=60)


def test_depth_is_read_from_frames_that_were_not_seen(network: DepthNetwork) -> None:
    clips = [clip(seed) for seed in range(100, 110)]
    estimated = [network(each["rgb"]) for each in clips]
    assert {depth.unit for depth in estimated} == {"metres"}
    truth = np.stack([each["depth"] for each in clips])
    scores = depth_scores(truth, np.stack([depth.maps for depth in estimated]), "none")
    always_far = depth_scores(truth, np.full_like(truth, 2.0), "none")
    assert scores.abs_rel.mean() < 0.15 < 0.3 < always_far.abs_rel.mean()
    assert estimated[0].extent == (estimated[0].maps.min(), estimated[0].maps.max())


def test_a_frame_has_the_same_depth_in_any_video(network: DepthNetwork) -> None:
    frames = np.concatenate([clip(seed)["rgb"] for seed in range(5)])
    together = network(frames).maps
    alone = np.concatenate([network(frames[i : i + 1]).maps for i in range(len(frames))])
    np.testing.assert_allclose(together, alone, rtol=1e-5)


def test_training_depends_on_the_clips_and_steps_alone() -> None:
    clips = [clip(seed) for seed in range(3)]
    one, other = (train_depth_network(clips, steps=2)(clips[0]["rgb"]).maps for _ in range(2))
    np.testing.assert_array_equal(one, other)


def test_the_loss_is_the_mean_error_of_the_logarithm_where_there_is_depth(network: DepthNetwork) -> None:
    frames = clip(0)["rgb"].astype(np.float32)
    depth = np.array(clip(0)["depth"])
    depth[:, :5] = 0
    estimated = network(clip(0)["rgb"]).maps
    expected = np.mean(np.abs(np.log(estimated[depth > 0]) - np.log(depth[depth > 0])))
    np.testing.assert_allclose(loss(network.params, jnp.asarray(frames), jnp.asarray(depth)), expected, rtol=1e-4)


def test_varied_frames_keep_things_in_their_places() -> None:
    frames = np.full((30, SIDE, SIDE, 3), 100, np.uint8)
    frames[:, 4:12, 2:10] = 200
    images = varied(np.random.default_rng(0), frames)
    assert images.min() >= 0 and images.max() <= 255
    inside = images[:, 6:10, 4:8].mean((1, 2, 3))
    outside = images[:, 14:, 13:].mean((1, 2, 3))
    assert np.all(inside > outside)
    assert len(set(np.round(inside))) > 10
