from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from rsjax.clip import Video
from rsjax.config import ConfigError, RoboScapeConfig, StateHeadsConfig
from rsjax.data.normalization import Normalization
from rsjax.data.store import Store
from rsjax.errors import UserError
from rsjax.files import write_json
from rsjax.models.base import Assets, create_model
from rsjax.models.trained import TrainedModel
from rsjax.tools.policies.config import PolicyConfig
from rsjax.tools.policies.judges.judge import HISTORY
from rsjax.tools.policies.planning import closed_loop as planning
from rsjax.tools.policies.planning import energies
from rsjax.tools.policies.planning.closed_loop import PlanSettings, compare, energy_of, folder, results_text
from rsjax.tools.policies.planning.energies import RecentFrames, imagined, judged, pixel_distance, token_distance
from rsjax.tools.policies.planning.planner import Planner, PlannerConfig, search
from rsjax.tools.policies.planning.proposals import policy_rollouts, similar_clips, similar_demos
from rsjax.tools.policies.worlds.model_world import FirstFrame, ModelWorld
from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld
from rsjax.tools.policies.worlds.world import run_episodes
from rsjax.tools.sim.expert import LiftState
from tests.models.toy_family import ToyConfig
from tests.tools.pipeline import toy
from tests.tools.policies.toy import demos
from tests.tools.policies.toy_worlds import ToySimulator

LOW, HIGH = -np.ones(2), np.ones(2)
GOAL = np.array([0.9, -1.4])
SEEN = 2  # frames of a prompt
FUTURE = 3
CANDIDATES = 2


def distance(start: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """A point that actions move: how far from the goal it ends."""
    return np.square(start + 0.5 * candidates.sum(1) - GOAL).sum(-1)


def distance_on_the_way(start: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """The mean over its way: a planner that sees only the end may put it off for ever."""
    return np.square(start + 0.5 * candidates.cumsum(1) - GOAL).sum(-1).mean(-1)


@pytest.mark.parametrize("method", ["cem", "mppi"])
def test_a_search_finds_the_way_to_the_goal_and_a_closed_loop_reaches_it(method: Any) -> None:
    config = PlannerConfig(method, horizon=4, candidates=100, rounds=8, elites=10, temperature=0.1)
    plan = search(distance, np.zeros(2), np.zeros((4, 2)), LOW, HIGH, HIGH, config, np.random.default_rng(0))
    assert plan.energy == pytest.approx(distance(np.zeros(2), plan.actions[None])[0])
    assert plan.energy < 0.02 < distance(np.zeros(2), np.zeros((1, 4, 2)))[0]
    assert (np.diff(plan.best) <= 0).all() and plan.best[-1] < plan.best[0]
    planner, here = Planner(distance_on_the_way, LOW, HIGH, config), np.zeros(2)
    for _ in range(6):
        action = planner(here)
        assert ((action >= LOW) & (action <= HIGH)).all()
        here = here + 0.5 * action
    assert np.abs(here - GOAL).max() < 0.15
    first = Planner(distance_on_the_way, LOW, HIGH, config)(np.zeros(2))
    planner.reset()
    np.testing.assert_array_equal(planner(np.zeros(2)), first)


@pytest.mark.parametrize("method", ["cem", "mppi"])
def test_impossible_candidates_are_left_out_of_the_search(method: Any) -> None:
    def walled(start: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        """No way leads through a wall, which most of the first candidates hit."""
        hit = (start + 0.5 * candidates.cumsum(1))[..., 0].min(-1) < 0
        return np.where(hit, np.inf, distance(start, candidates))

    config = PlannerConfig(method, horizon=4, candidates=100, rounds=8, elites=10, temperature=0.1)
    inputs: Any = (np.zeros(2), np.zeros((4, 2)), LOW, HIGH, HIGH, config, np.random.default_rng(0))
    assert search(walled, *inputs).energy < 0.05
    nowhere = search(lambda _, rows: np.full(len(rows), np.inf), *inputs)
    assert nowhere.energy == np.inf and np.isfinite(nowhere.actions).all()


def test_the_mean_of_elites_leaves_impossible_candidates_out() -> None:
    means: list[np.ndarray] = []

    def only_one(start: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        means.append(candidates[0])
        return np.where(np.arange(len(candidates)) == 5, 1.0, np.inf)

    config = PlannerConfig("cem", horizon=2, candidates=8, rounds=2, elites=4)
    plan = search(only_one, None, np.zeros((2, 2)), LOW, HIGH, HIGH, config, np.random.default_rng(0))
    np.testing.assert_array_equal(means[1], plan.actions)


def test_held_controls_repeat_and_wrong_energies_are_named() -> None:
    config = PlannerConfig(candidates=8, elites=2, hold=3)
    seen: list[np.ndarray] = []
    planner = Planner(lambda _, rows: seen.append(rows) or rows.sum((1, 2)), -np.ones(6), np.ones(6), config)  # type: ignore[func-returns-value]
    action = planner(None)
    np.testing.assert_array_equal(action.reshape(3, 2), np.tile(action[:2], (3, 1)))
    assert seen[0].shape == (8, 12, 6)
    with pytest.raises(ConfigError, match="planner.hold is 4; it must divide the 6 numbers"):
        Planner(distance, -np.ones(6), np.ones(6), replace(config, hold=4))
    with pytest.raises(ConfigError) as refused:
        PlannerConfig(seed=-1)
    assert "planner.seed is -1" in str(refused.value)
    with pytest.raises(ConfigError, match="planner.elites is 9"):
        replace(config, elites=9)
    for wrong in (np.zeros((8, 1)), np.full(8, np.nan), np.full(8, -np.inf)):
        with pytest.raises(UserError, match=r"the energy of 8 candidates has shape .*; expected \(8,\), numbers"):
            Planner(lambda _, rows, wrong=wrong: wrong, -np.ones(6), np.ones(6), config)(None)  # type: ignore[misc]


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return toy.store(tmp_path_factory.mktemp("plan") / "clips")


@pytest.fixture(scope="module")
def model(clips: Store) -> TrainedModel:
    return toy.trained(clips)


@pytest.fixture(scope="module")
def summing(clips: Store) -> TrainedModel:
    """A model with state heads that reads sums of actions."""
    config = toy.config()
    assert isinstance(config.model, RoboScapeConfig)
    departures = replace(config.model.departures, integrate_actions=True)
    return toy.trained(clips, toy.with_model(config, departures=departures, state_heads=StateHeadsConfig()))


def candidates_of(rng: np.random.Generator) -> np.ndarray:
    """The actions of each candidate, with equal ones in the prompt."""
    before = rng.normal(0, 0.4, (1, SEEN, 28)).repeat(CANDIDATES, 0)
    after = rng.normal(0, 0.4, (CANDIDATES, FUTURE, 28))
    return np.concatenate([before, after], 1).astype(np.float32)


def test_a_planner_acts_in_frames_with_and_without_depth() -> None:
    asked: list[RecentFrames] = []

    def plan(seen: Any) -> np.ndarray:
        asked.append(seen)
        return np.full(2, len(asked))

    for depths in ({"depth": np.ones((1, 4, 4), np.float32)}, {}):
        asked.clear()
        act = planning.PlanningActor(cast(Planner, plan), 2, depth=True)
        for _ in range(3):
            act({"rgb": np.zeros((1, 4, 4, 3), np.uint8)} | depths)
        assert [len(seen.rgb) for seen in asked] == [1, 2, 2]
        assert [None if seen.depth is None else len(seen.depth) for seen in asked] == (
            [1, 2, 2] if depths else [None] * 3
        )
        assert [seen.actions[-1, 0] for seen in asked] == [0, 1, 2]
    assert [np.asarray(seen.past)[:, 0].tolist() for seen in asked] == [[], [], [1]]


def test_energies_are_scores_of_what_a_model_generates() -> None:
    config = replace(toy.config(), model=ToyConfig())
    model = TrainedModel(config, create_model(config), {"gain": 0.3}, Assets(Normalization((0.0,), (1.0,), None), None))
    rgb, rng = toy.clip(0).rgb[:2], np.random.default_rng(0)
    candidates = rng.uniform(-0.2, 0.2, (2, 6, 28)).astype(np.float32)
    seen = RecentFrames(rgb, None, rng.normal(size=(2, 28)).astype(np.float32))
    actions = np.concatenate([np.repeat(seen.actions[None], 2, 0), candidates], 1)
    videos = model.plan(rgb, actions).rgb[:, -HISTORY:]
    goal = videos[1, -1]
    found = imagined(model, pixel_distance(goal))(seen, candidates)
    assert found[1] == 0 < found[0]
    assert found[0] == pytest.approx(np.square((videos[0, -1].astype(float) - goal) / 255).mean(), rel=1e-4)
    given: list[np.ndarray] = []

    def judge(frames: np.ndarray) -> np.ndarray:
        given.append(frames)
        return np.stack([frames[:, -1].mean((1, 2, 3)) / 255] * 3, -1)

    assert imagined(model, judged(judge))(seen, candidates) == pytest.approx(1 - videos[:, -1].mean((1, 2, 3)) / 255)
    np.testing.assert_array_equal(given[0], videos)


def test_success_is_read_from_the_models_own_head_by_the_runs_rule(
    model: TrainedModel, summing: TrainedModel, tmp_path: Path
) -> None:
    with pytest.raises(UserError) as refused:
        energies.success(model)
    assert "has no state heads" in str(refused.value)
    rgb = toy.clip(0).rgb[:SEEN]
    actions = candidates_of(np.random.default_rng(0))
    asked = RecentFrames(rgb, None, actions[0, :SEEN]), actions[:, SEEN:]
    found = energies.success(summing)(*asked)
    state = summing.plan(rgb, actions).state
    assert state is not None
    p = state[:, :, 0].astype(np.float64)
    np.testing.assert_allclose(found, 1 - p[:, SEEN:].mean(1), rtol=1e-5)  # after the prompt
    assert abs(found[0] - found[1]) > 0
    write_json(tmp_path / "judge_head" / "validation.json", {"in_a_row": 2, "shift": -1.5})
    shifted = 1 / (1 + (1 - p) / p * np.exp(1.5))
    least = np.minimum(shifted[:, 1:], shifted[:, :-1])  # the prompt's last frame counts for the first of the horizon
    least[:, SEEN - 1] = np.where(np.isnan(p[:, SEEN - 1]), 0, least[:, SEEN - 1])
    ruled = energy_of(summing, tmp_path, PlanSettings(energy="success"), rgb[0])(*asked)
    np.testing.assert_allclose(ruled, 1 - least[:, SEEN - 1 :].mean(1), rtol=1e-5)


def test_every_search_begins_with_a_policys_way_and_leaves_it_for_a_clearly_better_one() -> None:
    seen: list[np.ndarray] = []
    way = np.array([[0.5, -0.5, 0.3, -0.7], [0.25, 0.75, 0.25, 0.75]])  # two frames of two controls
    plans = np.stack([way, -way])
    wanted = np.concatenate([-way, -way[1:]])

    def energy(frames: Any, rows: np.ndarray) -> np.ndarray:
        seen.append(rows)
        return 1 + np.square(rows - wanted).sum((1, 2))

    def planner(margin: float = 0.0) -> Planner:
        config = PlannerConfig(horizon=3, candidates=8, rounds=2, hold=2, margin=margin)
        scale = np.array([0.1, 0.0, 0.1, 0.0])
        return Planner(energy, np.tile(LOW, 2), np.tile(HIGH, 2), config, lambda frames: plans, scale)

    one = planner()
    action = one(None)
    longer = np.concatenate([way, way[1:]])
    np.testing.assert_allclose(seen[0][[0, 3, 4]], np.stack([longer, longer, -longer]), atol=1e-6)
    noise = seen[0][5:] - longer
    np.testing.assert_allclose(noise[..., :2], noise[..., 2:], atol=1e-6)  # the same in both controls of a frame
    assert 0.02 < noise[..., 0].std() < 0.2 and not noise[..., 1].any()
    np.testing.assert_allclose(action, -way[0], atol=1e-6)  # nothing can be better
    assert one.plan is not None and one.plan.energy == pytest.approx(1)
    np.testing.assert_allclose(planner(margin=0.95)(None), way[0], atol=1e-6)
    one(None)
    np.testing.assert_allclose(seen[-2][2], np.concatenate([-way[1:], -way[1:], -way[1:]]), atol=1e-6)  # the last plan


def test_a_policys_rollouts_are_its_episodes_in_the_world_model(model: TrainedModel) -> None:
    def plans(frames: np.ndarray, seed: int = 0) -> np.ndarray:
        seen = frames[:, -2:].mean((1, 2, 3), dtype=np.float64) / 255  # of each colour
        return np.tile(seen - 0.5, 10)[:, :28, None].repeat(3, axis=2).swapaxes(1, 2).astype(np.float32)

    taken: list[np.ndarray] = []
    planned: list[np.ndarray] = []

    def act(observation: dict[str, np.ndarray]) -> np.ndarray:
        taken.append(observation["rgb"] if taken else first[None])  # the world shows it as the model sees it
        if len(taken) % 2:
            planned[:] = [plans(np.stack(taken[-2:], axis=1))]
        return planned[0][:, (len(taken) - 1) % 2]

    first = toy.clip(0).rgb[0]
    policy: Any = SimpleNamespace(action_dim=28, executed_frames=2, model=SimpleNamespace(config=PolicyConfig()))
    policy.plans = plans
    depth = toy.clip(0).depth
    assert depth is not None
    recent = RecentFrames(first[None], depth[:1], np.zeros((1, 28), np.float32))
    rolled = policy_rollouts(model, policy, 2, 5, 0, recent)
    (episode,) = run_episodes(ModelWorld(model, 1, None), act, [FirstFrame(first, depth[0], 0)], 5)
    np.testing.assert_array_equal(rolled[0], rolled[1])  # this policy draws nothing
    np.testing.assert_allclose(rolled[0], episode.actions[1:], atol=1e-4)
    assert np.ptp(rolled[0], axis=0).min() > 1e-3


def lifts(*firsts: int) -> Any:
    """A store of clips that succeed in these frames alone."""
    clips = [toy.clip(number) for number in range(len(firsts))]
    frames = np.arange(len(clips[0].rgb))
    records = [vars(clip) | {"success": frames == first} for clip, first in zip(clips, firsts, strict=True)]
    return SimpleNamespace(path=Path("clips"), source=lambda split: records)


def test_similar_clips_are_followed_from_their_most_similar_frame_before_success() -> None:
    similar = similar_clips(lifts(3, 2, 99, 0))  # the third never succeeds, the last from the beginning
    one, other = toy.clip(0), toy.clip(1)
    ways = similar.ways(one.rgb[1], 9, 2)
    assert ways.shape == (2, 2, 28)
    np.testing.assert_array_equal(ways[0], one.actions[2:4])
    np.testing.assert_array_equal(similar.ways(other.rgb[0], 1, 3), other.actions[None, 1:4])
    np.testing.assert_array_equal(similar.ways(one.rgb[4], 1, 2)[0], one.actions[3:5])  # it has succeeded in frame 3
    beyond = similar.ways(one.rgb[2], 1, 99)[0]
    rest = len(one.rgb) - 3
    np.testing.assert_array_equal(beyond[:rest], one.actions[3:])
    assert (beyond[rest:] == one.actions[-1]).all()
    with pytest.raises(UserError) as refused:
        similar_clips(lifts(99, 0))
    assert "clips: none of its training clips succeeds" in str(refused.value)


def test_demonstrations_are_followed_up_to_their_last_frames_in_several_episodes_at_once() -> None:
    similar = similar_demos(demos(3))
    frames = np.stack([demos(3)[1]["rgb"][4], demos(3)[0]["rgb"][-1]])
    actions = similar.actor()({"rgb": frames})
    np.testing.assert_array_equal(actions[0], demos(3)[1]["actions"][5])
    np.testing.assert_array_equal(actions[1], demos(3)[2]["actions"][-1])  # the last frame but one looks like this, too
    assert similar.key != similar_demos(demos(2)).key == similar_demos(demos(2)).key


def test_the_distance_of_tokens_counts_bits(model: TrainedModel) -> None:
    frames = np.stack([toy.clip(number).rgb[:1] for number in range(2)])
    found = token_distance(model, frames[1, 0])(frames)
    assert found[1] == 0 < found[0] <= 1
    by_hand = [bin(int(x)).count("1") for x in np.bitwise_xor(*model.encode(frames)["rgb"][:, 0]).ravel()]
    assert found[0] == pytest.approx(np.mean(by_hand) / model.config.tokenizer.code_bits)


def test_the_distance_of_lpips_compares_last_frames_with_the_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    def distances(params: float, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        assert one.shape == other.shape
        return params * np.abs(one.astype(float) - other).mean((1, 2, 3))

    monkeypatch.setattr(energies, "load_lpips", lambda weights: 2.0)
    monkeypatch.setattr(energies, "distances", distances)
    monkeypatch.setattr(energies, "min_size", lambda params: 8)
    goal, videos = np.full((8, 8, 3), 7, np.uint8), np.zeros((2, 3, 8, 8, 3), np.uint8)
    videos[1, -1] = 7
    assert energies.lpips_distance(Path("weights"), goal)(videos).tolist() == [14, 0]
    with pytest.raises(UserError, match="weights: frames have 4 pixels; this network needs 8"):
        energies.lpips_distance(Path("weights"), goal[:4, :4])


class FakeLift(ToySimulator):
    """Stands in for Lift: done once a control's first number is large, as the expert's is far from the cube."""

    state: Any = LiftState(np.zeros(3), np.zeros(3), 0.0, np.array([1.0, 0.0, 0.8]), 0.0)

    def reset(self, seed: int) -> None:
        self.place = 0.0

    def step(self, control: np.ndarray) -> None:
        super().step(np.zeros(7))
        if control[0] > 0.99:
            self.place = 10.0


def lift(diverges: bool = False) -> SimulatorWorld:
    simulators: Any = [FakeLift(64, diverges)]
    return SimulatorWorld(simulators, 4, 7)


def test_a_comparison_resumes_and_counts(model: TrainedModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "imagined", lambda trained, score: lambda seen, rows: -rows[:, 0, 0])
    search = PlannerConfig(rounds=6, candidates=30, elites=5, horizon=2)
    settings = PlanSettings(search, energy="pixels", episodes=3, max_steps=3)
    result = compare(model, tmp_path, lift(), settings)
    ways = {name: way["success"] for name, way in result["ways"].items()}
    assert ways == {"random": 0.0, "expert": 1.0, "cem": 1.0, "mppi": 1.0}
    assert result["ways"]["cem"]["seconds_per_decision"] > 0
    assert result["ways"]["cem"]["episodes"] == 3 and result["ways"]["random"]["success_high"] > 0.3
    place = folder(tmp_path, result["key"])
    saved = (place / "result.json").read_text()
    assert results_text(result) == (place / "results.md").read_text()
    assert "| cem | 100% |" in " ".join(results_text(result).split())
    assert {path.name for path in place.glob("*.mp4")} == {f"{way}-{n:02d}.mp4" for way in ways for n in range(3)}
    one = replace(settings, methods=(), episodes=1)
    for number in range(2):  # another policy has another folder
        policy: Any = SimpleNamespace(action_dim=28, sizes=(64, 28), key=str(number))
        policy.actor = lambda seed: lambda frames: np.ones((1, 28), np.float32)
        policy.plans = lambda frames, seed: np.ones((len(frames), 4, 28), np.float32)
        policy.executed_frames = 4
        other = compare(model, tmp_path, lift(), one, {"policy a/b": policy})
        assert other["ways"]["policy a/b"]["success"] == 1
        assert (folder(tmp_path, other["key"]) / "policy a-b-00.mp4").exists()
        assert len(list((tmp_path / "plan").glob("[!.]*"))) == 2 + number
    warm = replace(one, methods=("cem",), warm_start=True)
    warmed = compare(model, tmp_path, lift(), warm, {"policy a/b": policy})["ways"]
    assert list(warmed) == ["random", "expert", "policy a/b", "cem", "cem from policy a/b"]
    assert warmed["cem from policy a/b"]["steps"] == 1  # the policy's plans press at once
    clips = lifts(3, 2)
    for record in clips.source("train"):
        record["actions"] = np.ones_like(record["actions"])
    followed = compare(model, tmp_path, lift(), replace(one, methods=("cem",)), clips=clips)["ways"]
    assert list(followed) == ["random", "expert", "similar clips", "cem", "cem from similar clips"]
    assert followed["similar clips"]["steps"] == followed["cem from similar clips"]["steps"] == 1  # they press at once
    with pytest.raises(ConfigError) as caught:
        compare(model, tmp_path, lift(), warm)
    assert "no policy to start from" in str(caught.value)
    monkeypatch.setattr(planning, "lpips_distance", lambda weights, goal: None)
    keys = []
    for name, content in (("a", b"1"), ("b", b"1"), ("a", b"2")):  # weights count by their content
        (tmp_path / name).write_bytes(content)
        lpips = replace(one, energy="lpips", lpips_weights=str(tmp_path / name))
        keys.append(compare(model, tmp_path, lift(), lpips)["key"])
    assert keys[0] == keys[1] != keys[2]
    assert compare(model, tmp_path, SimulatorWorld([], 4, 7), settings) == result  # no episode is run again
    assert (place / "result.json").read_text() == saved
    fewer = compare(model, tmp_path, SimulatorWorld([], 4, 7), replace(settings, episodes=2))
    assert fewer["episodes"] == result["episodes"][:8] and fewer["ways"]["cem"]["episodes"] == 2
    more = compare(model, tmp_path, lift(), replace(settings, episodes=4))  # it goes on
    assert more["episodes"][:12] == result["episodes"] and more["ways"]["cem"]["episodes"] == 4
    with pytest.raises(UserError, match="no judge there; train one with rsjax judge"):
        compare(model, tmp_path, lift(), replace(settings, energy="judge"))
    with pytest.raises(ConfigError, match="needs lpips_weights"):
        replace(settings, energy="lpips")
    lost = compare(model, tmp_path, lift(diverges=True), replace(settings, episodes=1, max_steps=2))["ways"]
    assert {name: (way["success"], way["steps"]) for name, way in lost.items()} == dict.fromkeys(ways, (0.0, 2.0))
    still: Any = replace(model.config.model, action_encoder="none")  # type: ignore[call-arg]
    with pytest.raises(UserError, match=r"the model takes no actions \(family 'roboscape'\)"):
        compare(replace(model, config=replace(model.config, model=still)), tmp_path, lift(), settings)


def test_sums_of_actions_go_on_from_those_before_the_prompt(summing: TrainedModel) -> None:
    rng = np.random.default_rng(0)
    rows = candidates_of(rng)
    inputs = summing.params, summing.assets, Video(toy.clip(0).rgb[None, :SEEN]), rows
    model = summing.model
    plain = model.plan(*inputs)
    at_rest = model.plan(*inputs, past=np.zeros((5, 28), np.float32))
    np.testing.assert_allclose(at_rest.rgb, plain.rgb, atol=1)
    past = rng.normal(0, 0.4, (2, 28)).astype(np.float32)
    moved = model.plan(*inputs, past=past)
    assert (moved.rgb != plain.rgb).any()
    # It adds the same to all frames after the first, as their positions could.
    added = past.sum(0) / np.maximum(summing.assets.normalization.action_std, 1e-3) / 4
    positions = summing.params["pos_embed"].copy()
    positions[1:] += added.astype(np.float32) @ summing.params["action_encoder"]["kernel"][28:]
    placed = model.plan(summing.params | {"pos_embed": positions}, *inputs[1:])
    np.testing.assert_allclose(placed.rgb.astype(int), moved.rgb, atol=1)
