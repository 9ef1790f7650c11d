import multiprocessing
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from rsjax.clip import Clip
from rsjax.config import ConfigError, SimConfig
from rsjax.errors import UserError
from rsjax.tools.play.simulate import Job, simulate
from rsjax.tools.policies.worlds.actions import ActionError
from rsjax.tools.policies.worlds.environments import LiftEnv
from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld
from rsjax.tools.policies.worlds.world import run_episodes
from rsjax.tools.sim.episode import EpisodePlan, clip_seed, run_episode
from rsjax.tools.sim.expert import skilled_expert
from rsjax.tools.sim.lift import LiftSim

CONFIG = SimConfig(episodes=4, test_episodes=1, frames=4, tracks=20, seed=5, camera="near")


@pytest.fixture(scope="module")
def env(gl: str) -> Iterator[LiftEnv]:
    env = LiftEnv(CONFIG, max_steps=3)
    yield env
    env.close()


@pytest.fixture(scope="module")
def clip(gl: str) -> Clip:
    with LiftSim(CONFIG.camera, CONFIG.image_size) as sim:
        return run_episode(sim, CONFIG, EpisodePlan("000002", 2))


def test_the_simulator_beside_the_dream_gives_a_clips_frames(clip: Clip) -> None:
    work, seed = simulate(CONFIG), clip_seed(clip.provenance)
    for _ in range(2):  # it begins again for another branch
        jobs = [Job("", seed, None, True), *(Job("", None, row, True) for row in clip.actions[1:])]
        frames = [frame for frame in map(work, jobs) if frame is not None]
        np.testing.assert_array_equal(np.stack([frame.rgb for frame in frames]), clip.rgb)
        np.testing.assert_array_equal(np.stack([frame.depth for frame in frames]), clip.depth)


def test_replaying_a_clip_gives_its_frames(env: LiftEnv, clip: Clip) -> None:
    rows = iter(clip.actions[1:])
    with closing(SimulatorWorld.lift(CONFIG, 1)) as world:
        (episode,) = run_episodes(world, lambda seen: next(rows)[None], [clip_seed(clip.provenance)], 3)
    frame, _ = env.reset(seed=clip_seed(clip.provenance))
    frames = [frame] + [env.step(row)[0] for row in clip.actions[1:]]
    np.testing.assert_array_equal(np.stack([frame["rgb"] for frame in frames]), clip.rgb)
    np.testing.assert_array_equal(episode.rgb, clip.rgb)
    np.testing.assert_array_equal(episode.depth, clip.depth)
    np.testing.assert_array_equal(episode.actions, clip.actions)
    np.testing.assert_array_equal(episode.success, clip.success)
    assert episode.clipped == 0


def test_the_expert_lifts_and_its_actions_lift_again(gl: str) -> None:
    expert = skilled_expert(0)
    with closing(SimulatorWorld.lift(SimConfig(camera="near", image_size=16), 1)) as world:
        (first,) = run_episodes(world, lambda seen: [expert.act], [11], 20)
        rows = iter(first.actions[1:])
        (again,) = run_episodes(world, lambda seen: next(rows)[None], [11], 20)
    assert first.success[-1] and not first.success[:-1].any()
    np.testing.assert_array_equal(first.rgb, again.rgb)
    assert again.success[-1]


def test_simulators_in_processes_do_what_those_in_this_process_do(gl: str) -> None:
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1.2, 1.2, (2, 3, CONFIG.action_dim))
    ignored = np.array([False, True, False])
    again = np.array([False, True, False])
    with closing(SimulatorWorld.lift(CONFIG, 3)) as here, closing(SimulatorWorld.lift(CONFIG, 3, 2)) as elsewhere:
        assert not elsewhere.simulators and elsewhere.count == here.count and elsewhere.key == here.key
        for world_call in (
            lambda world: world.reset([1, 2, 3]),
            lambda world: world.step(rows[0]),
            lambda world: world.step(rows[1], ignored=ignored),
            lambda world: world.reset([4], which=again),
            lambda world: world.reset([5, 6]),
            lambda world: world.step(rows[0, :2]),
        ):
            one, other = world_call(here), world_call(elsewhere)
            for name in ("rgb", "depth"):
                np.testing.assert_array_equal(one.observation[name], other.observation[name])
            for name in ("success", "actions", "clipped"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        with pytest.raises(UserError) as raised:
            elsewhere.step([skilled_expert(0).act] * 2)
        assert "functions act only in simulators of this process" in str(raised.value)
        multiprocessing.active_children()[0].kill()
        with pytest.raises(UserError) as raised:
            elsewhere.step(rows[0, :2])
        assert "a process of the simulator died" in str(raised.value)
    with pytest.raises(ConfigError):
        SimulatorWorld.lift(replace(CONFIG, camera="nowhere"), 2, 2)
    assert not multiprocessing.active_children()


def test_another_simulator_is_refused() -> None:
    with pytest.raises(ConfigError, match="sim.env is metaworld"):
        LiftEnv(replace(CONFIG, env="metaworld"))


def test_junk_is_refused(env: LiftEnv) -> None:
    junk: tuple[dict[str, Any], ...] = ({"config": None}, {"config": 5}, {"render_mode": "junk"}, {"render_mode": 5})
    for arguments in junk:
        with pytest.raises(UserError) as error:
            LiftEnv(**arguments)
        assert next(iter(arguments)) in str(error.value)
    options: tuple[Any, ...] = (5, {"junk": 1}, [], np.zeros(2))
    for wrong in options:
        with pytest.raises(UserError) as error:
            env.reset(options=wrong)
        assert "options are" in str(error.value)


def test_gymnasiums_checker_passes(env: LiftEnv) -> None:
    check_env(env, skip_render_check=True)
    assert "rsjax/Lift-v0" in gymnasium.registry


def test_actions_are_clipped_and_counted_or_refused(env: LiftEnv) -> None:
    env.reset(seed=0)
    wide = np.zeros(CONFIG.action_dim)
    wide[[3, 8]] = 1.5, -7
    assert env.step(wide)[4]["clipped"] == 2
    assert env.step(wide)[4]["clipped"] == 4
    with pytest.raises(UserError, match="out_of_range is 'no'; it is clip or refuse"):
        LiftEnv(CONFIG, out_of_range="no")  # type: ignore[arg-type]
    strict = LiftEnv(CONFIG, out_of_range="refuse")
    strict.reset(seed=0)
    with pytest.raises(ActionError, match=r"actions\[3\] is 1.5; expected -1 to 1, 6-D change"):
        strict.step(wide)
    strict.close()
    wrong: tuple[tuple[Any, str], ...] = (
        (np.zeros(7), r"shape \(7,\); expected \(28,\)"),
        (np.where(np.arange(28) == 5, np.nan, 0), r"actions\[5\] is nan"),
        ("left", "an action is str"),
    )
    for action, message in wrong:
        with pytest.raises(ActionError, match=message):
            env.step(action)
