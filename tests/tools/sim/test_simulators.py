"""What all simulators share, on Lift: they tell of divergence, and do not disturb one another."""

from pathlib import Path

import numpy as np
import pytest

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
