"""The world model as an environment: the frames of ``generate``, Gymnasium's rules, and errors that name shapes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import rsjax.tools.policies  # noqa: F401 - registers
from rsjax.config import SampleConfig, StateHeadsConfig
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.models.trained import TrainedModel
from rsjax.tools.pipeline.run import Run
from rsjax.tools.policies.judges.judge import HISTORY, LABELS, SUCCESS
from rsjax.tools.policies.worlds.actions import ActionError
from rsjax.tools.policies.worlds.environments import WorldModelEnv, WorldModelVectorEnv
from rsjax.tools.policies.worlds.starts import StartError
from tests.models.toy_family import ToyConfig
from tests.tools.pipeline import toy

STEPS = 9  # the window is 6 frames


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Where a run on simulated clips has them."""
    folder = tmp_path_factory.mktemp("env")
    return toy.store(Run(toy.config(), folder, folder).clips)


@pytest.fixture(scope="module")
def model(clips: Store) -> TrainedModel:
    config = toy.with_model(toy.config(), sample=SampleConfig(steps=2, temperature=1.0, unmask="greedy"))
    return toy.trained(clips, config)


def judge(frames: np.ndarray) -> np.ndarray:
    """Success where the last frame's first pixel is bright; it looks at nothing else."""
    assert frames.shape[1] == HISTORY
    bright = frames[:, -1, 0, 0, 0] > 140
    return np.stack([bright, ~bright, 0 * bright], -1).astype(float)


@pytest.fixture(scope="module")
def env(model: TrainedModel, clips: Store) -> WorldModelEnv:
    return WorldModelEnv(model, max_steps=STEPS, data_dir=clips.path.parent)


def actions(count: int, width: int) -> np.ndarray:
    return np.random.default_rng(3).uniform(-1, 1, (count, width)).astype(np.float32)


def test_steps_are_the_frames_of_generate_beyond_the_window(
    env: WorldModelEnv, model: TrainedModel, clips: Store
) -> None:
    rows, clip = actions(STEPS + 1, 28), clips.source("test")[1]
    rows[0] = 0
    video = model.generate(clip["rgb"][:1], rows, clip["depth"][:1])
    seen, info = env.reset(options={"clip": 1, "draw": 0})
    assert (info["clip"], info["label"], info["success"]) == (1, "unjudged", False)
    frames, over = [seen], False
    for row in rows[1:]:
        assert not over
        seen, reward, terminated, over, info = env.step(row)
        assert (reward, terminated, info["clipped"]) == (0, False, 0)
        frames.append(seen)
    assert over
    rgb, depth = (np.stack([frame[name] for frame in frames]) for name in ("rgb", "depth"))
    assert video.depth is not None
    # Images decoded in other numbers differ by float32's last bit, which moves a pixel a level.
    assert np.abs(rgb.astype(int) - video.rgb).max() <= 1
    np.testing.assert_allclose(depth, video.depth, rtol=0.01)
    assert np.ptp(rgb, axis=0).max() > 50


def test_a_given_frame_is_the_clips_own(env: WorldModelEnv, clips: Store) -> None:
    clip = clips.source("test")[2]
    held = env.reset(options={"clip": 2, "draw": 5})[0], env.step(np.ones(28))[0]
    frame = {"rgb": clip["rgb"][0], "depth": clip["depth"][0]}
    given = env.reset(options=frame | {"draw": 5})[0], env.step(np.ones(28))[0]
    for one, other in zip(held, given, strict=True):
        np.testing.assert_array_equal(one["rgb"], other["rgb"])
        np.testing.assert_array_equal(one["depth"], other["depth"])


def test_gymnasiums_checker_passes_and_make_finds_the_environment(model: TrainedModel, env: WorldModelEnv) -> None:
    check_env(env, skip_render_check=True)
    made = gymnasium.make("rsjax/WorldModel-v0", run=model, max_steps=2)
    assert made.observation_space == env.observation_space
    assert isinstance(made.unwrapped, WorldModelEnv)


def test_a_vector_of_environments_restarts_each_as_one_alone_would(model: TrainedModel, clips: Store) -> None:
    """Their episodes end at different times, as the judge says."""
    count, steps = 3, 12
    settings: dict[str, Any] = {"judge": judge, "max_steps": 5, "data_dir": clips.path.parent}
    many = gymnasium.make_vec("rsjax/WorldModel-v0", num_envs=count, run=model, **settings)
    assert isinstance(many, WorldModelVectorEnv)
    with pytest.raises(UserError, match="1 seeds for 3 environments"):
        many.reset(seed=[1])
    alone = WorldModelEnv(model, **settings)
    rows = np.random.default_rng(3).uniform(-1, 1, (steps, count, 28)).astype(np.float32)
    seen, _ = many.reset(seed=np.int64(4))  # type: ignore[arg-type]
    made = [(seen, np.zeros(count), np.zeros(count, bool), np.zeros(count, bool))]
    for number in range(steps):
        rows[number, made[-1][2] | made[-1][3]] = np.nan  # of episodes that begin anew, whose actions do not matter
        seen, reward, terminated, truncated, info = many.step(rows[number])
        assert info["_label"].all()
        made.append((seen, reward, terminated, truncated))
    ends = np.array([terminated | truncated for _, _, terminated, truncated in made])
    assert many.observation_space.contains(seen)
    assert len({tuple(column) for column in ends.T}) > 1, "all episodes end together, which tests nothing"
    for i in range(count):
        one, _ = alone.reset(seed=4 + i)
        for number in range(steps):
            if ends[number, i]:
                one, facts = alone.reset()[0], [0.0, False, False]
            else:
                one, *facts, _ = alone.step(rows[number, i])
            got = made[number + 1]
            assert np.abs(one["rgb"].astype(int) - got[0]["rgb"][i]).max() <= 1, (i, number)
            assert tuple(facts) == (got[1][i], got[2][i], got[3][i])


def test_a_success_ends_an_episode_with_a_reward(model: TrainedModel, clips: Store) -> None:
    sure = WorldModelEnv(model, judge=lambda frames: np.array([[0.8, 0.1, 0.1]]), data_dir=clips.path.parent)
    assert sure.reset(seed=0)[1]["label"] == LABELS[SUCCESS]
    _, reward, terminated, truncated, info = sure.step(np.zeros(28))
    assert (reward, terminated, truncated, info["success"]) == (1.0, True, False, True)
    assert info["verdict"].tolist() == [0.8, 0.1, 0.1]


def test_bad_actions_and_frames_are_named(env: WorldModelEnv, model: TrainedModel, tmp_path: Path) -> None:
    env.reset(seed=0)
    with pytest.raises(ActionError, match=r"actions have shape \(7,\); expected \(28,\), 6-D change of the goal pose"):
        env.step(np.zeros(7))
    with pytest.raises(ActionError, match=r"actions\[3\] is inf"):
        env.step(np.where(np.arange(28) == 3, np.inf, 0))
    assert env.step(np.full(28, 3))[4]["clipped"] == 28
    assert env.reset()[1]["clipped"] == 0
    wrong: dict[str, dict[str, Any]] = {
        "has shape (32, 32, 3) and type uint8; expected (64, 64, 3)": {"rgb": np.zeros((32, 32, 3), np.uint8)},
        "and type float64; expected": {"rgb": np.zeros((64, 64, 3))},
        "metres along the optical axis": {"rgb": np.zeros((64, 64, 3), np.uint8)},
        "no clip 5 in the test split, which has 0 … 4": {"clip": 5},
        "no option clips": {"clips": 5},
    }
    for message, options in wrong.items():
        with pytest.raises(StartError) as error:
            env.reset(options=options)
        assert message in str(error.value)
    with pytest.raises(UserError, match="max_steps is 0"):
        WorldModelEnv(model, max_steps=0)
    with pytest.raises(UserError, match="out_of_range is 'refused'; it is clip or refuse"):
        WorldModelEnv(model, out_of_range="refused")
    with pytest.raises(StartError, match='reset needs a first frame of its own: options={"rgb": …, "depth": …}'):
        WorldModelEnv(model, data_dir=tmp_path).reset()


def test_somebody_elses_agent_learns_in_it(env: WorldModelEnv) -> None:
    agents = pytest.importorskip("stable_baselines3", reason="it is in requirements-extras.txt (make extras)")
    agent = agents.PPO("MultiInputPolicy", env, n_steps=4, batch_size=4, n_epochs=1, seed=0)
    agent.learn(8)
    assert agent.num_timesteps == 8
    seen, _ = env.reset(seed=0)
    assert env.action_space.contains(agent.predict(seen)[0])


def test_a_family_without_steps_is_named(clips: Store) -> None:
    family = toy.trained(clips, replace(toy.config(), model=ToyConfig()))
    with pytest.raises(UserError, match="cannot generate frame by frame"):
        WorldModelEnv(family)
    still: Any = replace(toy.config().model, action_encoder="none")  # type: ignore[call-arg]
    with pytest.raises(UserError, match=r"the model takes no actions \(family 'roboscape'\)"):
        WorldModelEnv(toy.trained(clips, replace(toy.config(), model=still)))


def test_the_models_own_head_may_give_the_reward(clips: Store) -> None:
    with pytest.raises(UserError):
        WorldModelEnv(toy.trained(clips), judge="head")
    model = toy.trained(clips, toy.with_model(toy.config(), state_heads=StateHeadsConfig()))
    env = WorldModelEnv(model, judge="head", data_dir=clips.path.parent)
    _, info = env.reset(options={"clip": 1, "draw": 0})
    rows = actions(STEPS, 28)
    clip = clips.source("test")[1]
    state = model.generate(clip["rgb"][:1], np.concatenate([rows[:1], rows]), clip["depth"][:1]).state
    assert state is not None
    np.testing.assert_allclose([info["height"], info["opening"]], state[0, 1:], atol=1e-4)
    for number, row in enumerate(rows, 1):
        _, reward, terminated, _, info = env.step(row)
        assert reward == float(terminated) == float(state[number, 0] > 0.5)
        np.testing.assert_allclose(info["verdict"], [state[number, 0], 1 - state[number, 0], 0], atol=1e-4)
        if terminated:
            break
