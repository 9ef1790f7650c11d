"""What the camera on the hand sees beside the main camera."""

from dataclasses import replace

import numpy as np

from rsjax.config import SimConfig
from rsjax.data.store import encode_clip
from rsjax.tools.sim.collect import collection_key
from rsjax.tools.sim.episode import EpisodePlan, run_episode
from rsjax.tools.sim.grasps import Grasp
from rsjax.tools.sim.lift import LiftSim

CONFIG = SimConfig(episodes=4, test_episodes=1, frames=8, tracks=20, seed=5)
BOTH = replace(CONFIG, second_view="wrist")


def redness(frames: np.ndarray) -> np.ndarray:
    return (frames[..., 0].astype(int) - frames[..., 1:].max(-1) > 40).sum((1, 2))


def test_it_shows_the_cube_ever_larger_and_everything_else_is_as_without_it(sim: LiftSim) -> None:
    """Episodes before and after one with both views are the same, so the second renderer disturbs nothing."""
    plan = EpisodePlan("000001", 1, manner=Grasp(0.0, 0, 0.0))  # the hand comes down
    before = run_episode(sim, CONFIG, plan)
    both = run_episode(sim, BOTH, plan)
    assert both.second is not None
    np.testing.assert_array_equal(both.second[-1], sim.wrist_image)
    after = run_episode(sim, CONFIG, plan)
    for name, value in encode_clip(before).items():
        for other in (both, after):
            if name == "provenance":
                assert getattr(other, name) == value
            else:
                np.testing.assert_array_equal(getattr(other, name), value, err_msg=name)
    assert before.second is after.second is None
    assert both.second.shape == both.rgb.shape
    red = redness(both.second)
    assert 0 < red[0] < red[3] < red[5]
    assert not np.array_equal(both.second[-1], both.rgb[-1])


def test_clips_with_it_have_a_key_of_their_own() -> None:
    assert collection_key(BOTH) != collection_key(CONFIG)
