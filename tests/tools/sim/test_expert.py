from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from rsjax.tools.sim.expert import MODES, Expert, Manner, draw_manner
from rsjax.tools.sim.lift import LiftSim

STEPS = 60


def manner_of(mode: str, seed: int) -> Manner:
    rng = np.random.default_rng(seed)
    while (manner := draw_manner(rng)).mode != mode:
        pass
    return manner


def play(sim: LiftSim, manner: Manner, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The actions and the success predicate of one episode."""
    sim.reset(seed)
    expert = Expert(manner, np.random.default_rng(seed))
    actions, success = [], []
    for _ in range(STEPS):
        actions.append(expert.act(sim.state))
        sim.step(actions[-1])
        success.append(sim.success)
    return np.array(actions), np.array(success)


def test_modes_come_with_their_probabilities() -> None:
    rng = np.random.default_rng(0)
    count = Counter(draw_manner(rng).mode for _ in range(2000))
    for mode, probability in MODES.items():
        assert count[mode] / 2000 == pytest.approx(probability, abs=0.04)
    assert sum(MODES.values()) == pytest.approx(1)


def test_each_mode_does_what_it_says(sim: LiftSim) -> None:
    seeds = range(3)
    runs = {mode: [play(sim, manner_of(mode, s), s)[1] for s in seeds] for mode in MODES}
    assert sum(s[-1] for s in runs["lift"]) >= 2
    assert sum(s.any() and not s[-1] for s in runs["drop"]) >= 2
    assert sum(s[-1] for s in runs["near_miss"]) <= 1
    assert not any(s.any() for s in runs["explore"])


def test_actions_are_in_range_and_noisy(sim: LiftSim) -> None:
    manner = manner_of("lift", 0)
    noisy, _ = play(sim, replace(manner, noise=0.2), 0)
    clean, _ = play(sim, replace(manner, noise=0.0, turn_noise=0.0), 0)
    assert np.abs(noisy).max() <= 1
    assert np.abs(clean).max() <= 1
    assert np.std(np.diff(noisy[:, :3], axis=0)) > 1.2 * np.std(np.diff(clean[:, :3], axis=0))


def test_turns_towards_the_cube(sim: LiftSim) -> None:
    def misalignment() -> float:
        difference = sim.state.cube_yaw - sim.state.gripper_yaw
        return abs((difference + np.pi / 4) % (np.pi / 2) - np.pi / 4)

    manner = replace(manner_of("lift", 0), delay=0, noise=0.0, turn_noise=0.0)
    for seed in range(20):
        sim.reset(seed)
        before = misalignment()
        if before < np.radians(25):
            continue
        expert = Expert(manner, np.random.default_rng(0))
        for _ in range(15):
            sim.step(expert.act(sim.state))
        assert misalignment() < before / 2
        return
    pytest.fail("no seed gave a turned cube")
