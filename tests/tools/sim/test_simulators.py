"""What all simulators share, on Lift: they name divergence, do not disturb one another, and know where things are."""

from pathlib import Path

import numpy as np
import pytest

from rsjax.config import SimConfig
from rsjax.tools.sim.episode import EpisodePlan, run_episode
from rsjax.tools.sim.lift import LiftSim


def test_a_simulation_that_diverges_is_told_though_it_begins_anew(
    sim: LiftSim, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    sim.reset(0)
    sim.step(np.zeros(7))
    sim._data.qvel[0] = np.nan
    with pytest.raises(ArithmeticError):
        sim.step(np.zeros(7))
    assert np.isfinite(sim._data.qpos).all()
    sim.reset(0)
    sim.step(np.zeros(7))


def test_closing_a_simulator_leaves_anothers_pictures_as_they_are(sim: LiftSim) -> None:
    sim.reset(0)
    expected = sim.render()
    with LiftSim(image_size=64) as other:
        other.reset(1)
        other.render()
        sim.render()
    found = sim.render()
    np.testing.assert_array_equal(found.rgb, expected.rgb)
    np.testing.assert_array_equal(found.depth, expected.depth)


@pytest.mark.parametrize("camera", ["near", "robot0_eye_in_hand"])
def test_the_cubes_place_is_where_its_picture_is(gl: str, camera: str) -> None:
    """The camera on the hand moves, so a place in frame t is seen by the camera of frame t."""
    config = SimConfig(episodes=4, test_episodes=1, frames=5, tracks=20, seed=5, camera=camera)
    with LiftSim(config.camera, config.image_size) as sim:
        clip = run_episode(sim, config, EpisodePlan("000002", 2))
    for frame, place in zip(clip.rgb.astype(int), clip.provenance["objects"]["cube"], strict=True):
        red = np.argwhere((frame[..., 0] > 1.8 * frame[..., 1]) & (frame[..., 0] > 60))
        centre = (red.mean(0)[::-1] + 0.5) / config.image_size
        np.testing.assert_allclose(place, centre, atol=0.03)
