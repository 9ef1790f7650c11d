"""Recorded policies, and the recipe that simulates their episodes once more."""

import os
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsjax.config import SimConfig
from rsjax.data.store import MANIFEST, write_store
from rsjax.errors import UserError
from rsjax.tools.policies.on_policy import rollouts
from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld
from rsjax.tools.sim.episode import POLICY, WINDOW, run_episode
from rsjax.tools.sim.recipes.plans import training_plans
from rsjax.tools.sim.recipes.recorded import recorded
from tests.tools.policies.toy import demo_store

CONFIG = SimConfig(episodes=5, test_episodes=1, frames=3, tracks=20, seed=5, camera="near", control_steps=2)


class Drawn:
    """A policy that draws its actions."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.key = f"drawn {seed}"

    def actor(self, seed: int) -> Any:
        rng = np.random.default_rng([self.seed, seed])
        return lambda observation: rng.uniform(-1, 1, (len(observation["rgb"]), 14)).astype(np.float32)


def test_what_a_policy_did_is_simulated_again(gl: str, tmp_path: Path) -> None:
    policies: Any = {"bad": Drawn(0), "worse": Drawn(1)}
    with closing(SimulatorWorld.lift(CONFIG, 2)) as world:
        store = rollouts(policies, world, CONFIG, {"train": range(4)}, 2, tmp_path, "record")
        recorded = [store.source("train")[number] for number in range(4)]
        names = [each["provenance"]["expert"]["policy"] for each in recorded]
        assert names == ["bad", "worse", "bad", "worse"]
        mix = replace(CONFIG, episodes=6, recipe=(f"recorded:{store.path}",))
        plans = training_plans(mix)
        assert len({plan.episode for plan in plans}) == 4, "five episodes of four starts"
        for plan, episode in zip((plans[2], plans[4]), (recorded[2], recorded[0]), strict=True):
            clip = run_episode(world.simulators[0], mix, plan)
            for name in ("rgb", "depth", "actions", "success", "tracks"):
                np.testing.assert_array_equal(getattr(clip, name), episode[name], err_msg=name)
            assert clip.provenance["expert"]["policy"] == "bad"
    with pytest.raises(UserError) as refused:
        training_plans(replace(mix, frames=9))
    assert "episodes of 3 frames and 14 numbers an action; sim.frames 9" in str(refused.value)


def write_recording(path: Path, **origin: int) -> None:
    provenance = {"expert": {"mode": POLICY}, "episode": 0, "seed": 0} | origin
    record = {"actions": np.zeros((CONFIG.frames, CONFIG.action_dim), np.float32), "provenance": provenance}
    write_store(path, "clips", {"train": [record]}, {})


def test_another_recording_at_the_same_path_is_read(tmp_path: Path) -> None:
    seeds = []
    for seed in (1, 2):
        write_recording(tmp_path / "store", seed=seed)
        os.utime(tmp_path / "store" / MANIFEST, (seed, seed))  # the clock may be too coarse, and the inode the same
        seeds.append(recorded(CONFIG, tmp_path / "store", 0, "episode").seed)
    assert seeds == [1, 2]


def test_windows_and_clips_that_no_policy_made_are_no_recordings(tmp_path: Path) -> None:
    write_recording(tmp_path / "store", **{WINDOW: 3})
    with pytest.raises(UserError) as refused:
        recorded(CONFIG, tmp_path / "store", 0, "episode")
    assert "begin in the middle of episodes" in str(refused.value)
    store = demo_store(tmp_path / "demos")
    with pytest.raises(UserError) as refused:
        training_plans(replace(CONFIG, recipe=(f"recorded:{store.path}",)))
    assert "its clips are not of policies in the simulator; make it with rsjax record" in str(refused.value)
