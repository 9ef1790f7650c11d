"""Grasps at set offsets and free drives, in the simulator."""

from pathlib import Path

import numpy as np
import pytest

from rsjax.config import SimConfig, to_dict
from rsjax.data.store import Store, encode_clip, open_store, write_store
from rsjax.tools.sim.drives import SMOOTH, WORKSPACE, Drive
from rsjax.tools.sim.episode import EpisodePlan, Replay, clip_seed, run_episode, source_name
from rsjax.tools.sim.expert import CLOSE, LiftState
from rsjax.tools.sim.grasps import STEPS, Grasp
from rsjax.tools.sim.lift import LiftSim
from rsjax.tools.sim.panda import STEP
from rsjax.tools.sim.probes import DRIVES, GRASPS, OFFSETS, collect_probes
from rsjax.tools.sim.unseen import UNITS

CONFIG = SimConfig(episodes=4, test_episodes=2, frames=16, tracks=1, seed=5)
RNG = np.random.default_rng(0)


def grasped(sim: LiftSim, grasp: Grasp, seed: int) -> tuple[float, bool]:
    """How far from the cube's first place the fingers close, and whether the cube is lifted at the end."""
    sim.reset(seed)
    cube = sim.state.cube
    expert = grasp.expert(RNG)
    closed = []
    for _ in range(STEPS):
        state = sim.state
        action = expert.act(state)
        if action[6] == CLOSE:
            closed.append(float(np.hypot(*(state.gripper - cube)[:2])))
        sim.step(action)
    return closed[0], sim.success


@pytest.mark.parametrize("offset", [0.0, 0.06])
def test_fingers_close_at_their_offset_and_it_decides(sim: LiftSim, offset: float) -> None:
    for direction in (0, 1):
        beside, lifted = grasped(sim, Grasp(offset, direction, 0.0), seed=direction)
        assert beside == pytest.approx(offset, abs=0.007)
        assert lifted == (offset == 0)


def test_the_actions_of_a_probe_lead_to_its_frames(sim: LiftSim) -> None:
    """What a model gets is what the simulator did: replayed from the same start, it does the same."""
    for manner in (Grasp(0.02, 1, 0.0), Drive()):
        clip = run_episode(sim, CONFIG, EpisodePlan("x", 1, manner=manner))
        again = run_episode(sim, CONFIG, EpisodePlan("x", 1, manner=manner, replay=Replay(clip.actions, 0.0)))
        for name in ("rgb", "depth", "actions", "tracks", "success"):
            np.testing.assert_array_equal(getattr(again, name), getattr(clip, name), err_msg=name)
        assert clip.provenance["expert"] == to_dict(manner)


def test_grasps_of_a_start_differ_in_their_offset_alone() -> None:
    for start in range(len(GRASPS) // len(OFFSETS)):
        of_start = [plan for plan in GRASPS if plan.episode == start]
        manners = [plan.manner for plan in of_start if isinstance(plan.manner, Grasp)]
        assert [manner.offset for manner in manners] == list(OFFSETS)
        assert len({(manner.direction, manner.height) for manner in manners}) == 1
    starts = {plan.episode for plan in GRASPS}
    assert len({plan.name for plan in GRASPS}) == len(GRASPS) == 84
    assert starts.isdisjoint(plan.episode for plan in DRIVES)


def test_a_drive_is_smooth_reverses_reaches_the_edges_and_grips() -> None:
    low, high = WORKSPACE
    goal = WORKSPACE.mean(axis=0)
    driver = Drive().expert(np.random.default_rng(3))
    actions = []
    goals = []
    for _ in range(2000):
        actions.append(driver.act(LiftState(goal, goal, 0.0, goal, 0.0)))
        goal = goal + STEP * actions[-1][:3]
        goals.append(goal)
    moves = np.array(actions)[:, :3]
    assert np.abs(actions).max() <= 1
    assert np.abs(np.diff(moves, axis=0)).max() <= 2 * SMOOTH
    assert (np.diff(np.sign(moves), axis=0) != 0).any(axis=0).all()
    assert set(np.array(actions)[:, 6]) == {-1.0, 1.0}
    margin = STEP * (1 - SMOOTH) / SMOOTH  # an action that is smoothed to 0 goes this much farther
    for found, edge in ((np.min(goals, axis=0), low), (np.max(goals, axis=0), high)):
        np.testing.assert_allclose(found, edge, atol=margin + STEP)


@pytest.fixture
def store(sim: LiftSim, tmp_path: Path) -> Store:
    meta: dict[str, object] = {name: [0.0, 1.0] for name in UNITS}
    meta |= {"key": "clips", "source": source_name(CONFIG), "config": to_dict(CONFIG)}
    short = SimConfig(frames=2, tracks=1)
    write_store(tmp_path / "lift", "clips", {"test": [encode_clip(run_episode(sim, short, EpisodePlan("2", 2)))]}, meta)
    return open_store(tmp_path / "lift")


def test_probes_are_made_once_beside_the_clips_in_their_units(store: Store) -> None:
    config = SimConfig(episodes=4, test_episodes=2, control_steps=1, image_size=16)
    counts: list[tuple[int, int]] = []
    probes = collect_probes(config, store, lambda *done: counts.append(done), 1, grasps=GRASPS[3:4], drives=DRIVES[:1])
    assert counts[-1] == (2, 2)
    (grasp,) = probes.grasps
    (drive,) = probes.drives
    assert grasp["rgb"].shape == (STEPS + 1, 16, 16, 3)
    assert len(drive["rgb"]) == 60
    assert grasp["provenance"]["expert"]["offset"] == OFFSETS[3]
    assert grasp["provenance"]["depth_range"] == [0.0, 1.0]
    assert clip_seed(grasp["provenance"]) != clip_seed({"seed": config.seed, "episode": 0})
    folders = sorted((store.path / "probes").glob("*/manifest.json"))
    again = collect_probes(config, store, lambda *done: None, 1, grasps=GRASPS[3:4], drives=DRIVES[:1])
    np.testing.assert_array_equal(again.drives[0]["rgb"], drive["rgb"])
    assert sorted((store.path / "probes").glob("*/manifest.json")) == folders
