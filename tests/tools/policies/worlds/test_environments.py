"""The world model as an environment: the frames of ``generate``, Gymnasium's rules, and errors that name shapes."""

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import rsjax
import rsjax.tools.policies  # registers the environments
from rsjax.config import SampleConfig, StateHeadsConfig
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.model_directory import CLIPS
from rsjax.models.trained import TrainedModel
from rsjax.tools.pipeline.run import Run
from rsjax.tools.policies.judges.judge import HISTORY, LABELS, SUCCESS
from rsjax.tools.policies.worlds.actions import ActionError
from rsjax.tools.policies.worlds.environments import WorldModelEnv, WorldModelVectorEnv
from rsjax.tools.policies.worlds.stable_baselines import vec_env
from rsjax.tools.policies.worlds.starts import StartError
from tests.models.toy_family import ToyConfig
from tests.tools.pipeline import toy

STEPS = 9  # the window is 6 frames
ROOT = Path(__file__).parents[4]
# A program that makes an episode begin, and prints how many programs it compiled and how many it read; then why
# processes that it forks cannot have environments.
PROCESS = """
import sys
from pathlib import Path

import gymnasium
import jax

events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
from rsjax.data.store import open_store
from rsjax.errors import UserError
from rsjax.tools.policies.worlds.environments import WorldModelEnv
from tests.tools.pipeline import toy

clips = open_store(Path(sys.argv[1]))
model = toy.trained(clips)
make = lambda: WorldModelEnv(model, data_dir=clips.path.parent)
env = make()
env.reset(seed=0)
env.step(env.action_space.sample())
print(*(events.count(f"/jax/compilation_cache/cache_{kind}") for kind in ("misses", "hits")))

many = gymnasium.vector.AsyncVectorEnv([make] * 2, shared_memory=False)
assert many.single_observation_space == env.observation_space
try:
    many.reset(seed=0)
except UserError as error:
    print(error)
finally:
    many.close(terminate=True)
"""


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


def test_without_depth_the_rgb_is_the_same(env: WorldModelEnv, model: TrainedModel, clips: Store) -> None:
    plain = WorldModelEnv(model, data_dir=clips.path.parent, judge=None, depth=False)
    start = {"clip": 1, "draw": 3}
    rows = actions(3, 28)
    wanted = [env.reset(options=start)[0], *[env.step(row)[0] for row in rows]]
    made = [plain.reset(options=start)[0], *[plain.step(row)[0] for row in rows]]
    for one, other in zip(made, wanted, strict=True):
        assert plain.observation_space.contains(one)
        assert list(one) == ["rgb"]
        # Programs that decode other pictures may differ by float32's last bit, which moves a pixel a level.
        assert np.abs(one["rgb"].astype(int) - other["rgb"]).max() <= 1


def test_a_given_frame_is_the_clips_own(env: WorldModelEnv, clips: Store) -> None:
    clip = clips.source("test")[2]
    held = env.reset(options={"clip": 2, "draw": 5})[0], env.step(np.ones(28))[0]
    frame = {"rgb": clip["rgb"][0], "depth": clip["depth"][0]}
    given = env.reset(options=frame | {"draw": 5})[0], env.step(np.ones(28))[0]
    for one, other in zip(held, given, strict=True):
        np.testing.assert_array_equal(one["rgb"], other["rgb"])
        np.testing.assert_array_equal(one["depth"], other["depth"])


def test_a_loaded_model_finds_the_clips_beside_it(model: TrainedModel, clips: Store, tmp_path: Path) -> None:
    model.save(tmp_path / "saved")
    shutil.copytree(clips.path, tmp_path / "saved" / CLIPS)
    loaded = rsjax.load(tmp_path / "saved")
    assert WorldModelEnv(loaded).reset(options={"clip": 1})[1]["clip"] == 1


def test_gymnasiums_checker_passes_and_make_finds_the_environment(model: TrainedModel, env: WorldModelEnv) -> None:
    check_env(env, skip_render_check=True)
    made = gymnasium.make("rsjax/WorldModel-v0", run=model, max_steps=2)
    assert made.observation_space == env.observation_space
    assert isinstance(made.unwrapped, WorldModelEnv)


def test_a_vector_of_environments_restarts_each_as_one_alone_would(model: TrainedModel, clips: Store) -> None:
    """Their episodes end at different times, as the judge says."""
    count = 2  # as everywhere in this file, so that programs are compiled once
    steps = 12
    settings: dict[str, Any] = {"judge": judge, "max_steps": 5, "data_dir": clips.path.parent}
    many = gymnasium.make_vec("rsjax/WorldModel-v0", num_envs=count, run=model, **settings)
    assert isinstance(many, WorldModelVectorEnv)
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
    with pytest.raises(StartError, match='reset needs a first frame of its own: options={"rgb": …, "depth": …}'):
        WorldModelEnv(model, data_dir=tmp_path).reset()


JUNK: tuple[Any, ...] = (-1, 1.5, "x", 10**400, True, [], {})


def test_junk_is_refused_at_one_border(env: WorldModelEnv, model: TrainedModel, clips: Store) -> None:
    where: dict[str, Any] = {"data_dir": clips.path.parent}
    settings: dict[str, tuple[Any, ...]] = {
        "max_steps": (0, *JUNK),
        "data_dir": (None, 7, "", "x" * 5000, "a\0b"),
        "split": (None, 7),
        "judge": (7, [1]),
        "out_of_range": ("ignore", None),
        "max_step": (9,),
        "render_mode": ("human", 5, np.zeros(2)),
    }
    for name, values in settings.items():
        for value in values:
            with pytest.raises(UserError) as raised:
                WorldModelEnv(model, **(where | {name: value}))
            assert name in str(raised.value)
    for count in (0, *JUNK):
        with pytest.raises(UserError) as raised:
            WorldModelVectorEnv(model, count, **where)
        assert str(raised.value).startswith("num_envs is ")
    several = WorldModelVectorEnv(model, 2, **where)
    for wrong in JUNK:
        for each in (env, several):
            if each is env or wrong != []:
                with pytest.raises(UserError):
                    each.reset(seed=wrong)
    with pytest.raises(UserError):
        several.reset(seed=np.array(3.0))  # type: ignore[arg-type]
    with pytest.raises(UserError) as raised:
        several.reset(seed=[1, 2, 3])
    assert "3 seeds for 2" in str(raised.value)
    options: tuple[Any, ...] = (7, "x", [1], {7: 1}, {"rgb": [[1], [1, 2]]})
    for option in (*options, {"clip": True}, *({"draw": wrong} for wrong in JUNK)):
        for each in (env, several):
            with pytest.raises(UserError):
                each.reset(seed=0, options=option)
    several.reset(seed=0)
    for action in (*JUNK, np.zeros((2, 28), bool), np.zeros((2, 28), complex), np.full((2, 28), "0"), [[1], [1, 2]]):
        with pytest.raises(ActionError):
            several.step(action)


class PlainVecEnv:
    """What stable-baselines3's VecEnv does for its subclasses, as far as this project's relies on it."""

    def __init__(self, num_envs: int, observation_space: Any, action_space: Any) -> None:
        self.num_envs = num_envs
        self.observation_space = observation_space
        self.action_space = action_space
        self._reset_seeds()
        self._reset_options()

    def _reset_seeds(self) -> None:
        self._seeds: list[int | None] = [None] * self.num_envs

    def _reset_options(self) -> None:
        self._options: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]

    def seed(self, seed: int) -> None:
        self._seeds = [seed + number for number in range(self.num_envs)]

    def step(self, actions: np.ndarray) -> Any:
        self.step_async(actions)  # type: ignore[attr-defined]
        return self.step_wait()  # type: ignore[attr-defined]


def test_a_vec_env_restarts_in_the_step_that_ends_an_episode(
    model: TrainedModel, clips: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a stand-in for stable-baselines3's base class, which need not be installed."""
    settings: dict[str, Any] = {"max_steps": 2, "data_dir": clips.path.parent}
    for name in ("stable_baselines3", "stable_baselines3.common", "stable_baselines3.common.vec_env"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    sys.modules["stable_baselines3.common.vec_env"].VecEnv = PlainVecEnv  # type: ignore[attr-defined]
    many = vec_env(model, 2, **settings)
    alone = WorldModelVectorEnv(model, 2, **settings)
    many.seed(5)
    seen, (expected, begun) = many.reset(), alone.reset(seed=[5, 6])
    np.testing.assert_array_equal(seen["rgb"], expected["rgb"])
    assert [info["clip"] for info in many.reset_infos] == begun["clip"].tolist()
    rows = actions(10, 28).reshape(5, 2, 28)
    many.step(rows[0])
    alone.step(rows[0])
    seen, reward, over, infos = many.step(rows[1])
    last = alone.step(rows[1])[0]
    first = alone.step(rows[2])[0]  # ignored actions: the episodes begin here
    assert over.all() and reward.dtype == np.float32
    for number, info in enumerate(infos):
        assert info["TimeLimit.truncated"] is True
        np.testing.assert_array_equal(info["terminal_observation"]["rgb"], last["rgb"][number])
    np.testing.assert_array_equal(seen["rgb"], first["rgb"])
    assert not many.step(rows[3])[2].any()
    with pytest.raises(UserError):
        many.env_method("render")
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    with pytest.raises(UserError) as raised:
        vec_env(model, 2, **settings)
    assert "pip install stable-baselines3" in str(raised.value)


def test_a_second_process_begins_with_the_compiled_programs_of_the_first_and_forked_ones_are_refused(
    clips: Store, tmp_path: Path
) -> None:
    counts = []
    for seed in ("1", "2"):
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "PYTHONHASHSEED": seed}
        line = [sys.executable, "-W", "ignore", "-c", PROCESS, str(clips.path)]
        done = subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        numbers, reason = done.stdout.splitlines()
        counts.append([int(word) for word in numbers.split()])
        assert '"context": "spawn"' in reason
    compiled = counts[0][0]
    assert compiled > 3
    assert counts == [[compiled, 0], [0, compiled]]


def test_an_answer_that_is_no_judges_is_refused(model: TrainedModel, clips: Store) -> None:
    for answer in (None, "yes", np.zeros((1, 2)), np.full((1, 3), np.nan), [[1], [1, 2]]):
        judged = WorldModelEnv(model, data_dir=clips.path.parent, judge=lambda frames, answer=answer: answer)
        with pytest.raises(UserError) as raised:
            judged.reset(seed=0)
        assert "the judge returned" in str(raised.value)


def test_somebody_elses_agent_learns_in_it(env: WorldModelEnv) -> None:
    agents = pytest.importorskip("stable_baselines3", reason="it is in requirements-extras.txt (make extras)")
    on_policy = agents.PPO("MultiInputPolicy", env, n_steps=4, batch_size=4, n_epochs=1, seed=0)
    off_policy = agents.SAC("MultiInputPolicy", env, learning_starts=4, batch_size=4, buffer_size=16, seed=0)
    for agent in (on_policy, off_policy):
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
    with pytest.raises(UserError) as refused:
        WorldModelEnv(toy.trained(clips), judge="head")
    assert "has no state heads" in str(refused.value)
    model = toy.trained(clips, toy.with_model(toy.config(), state_heads=StateHeadsConfig()))
    env = WorldModelEnv(model, judge="head", data_dir=clips.path.parent)
    _, info = env.reset(options={"clip": 1, "draw": 0})
    rows = actions(3, 28)
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
