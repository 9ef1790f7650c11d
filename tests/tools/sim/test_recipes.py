"""What the training episodes of Lift show."""

from collections import Counter
from dataclasses import asdict, replace

import numpy as np
import pytest

from rsjax.config import SimConfig
from rsjax.config.sim import EXPERT
from rsjax.config.sim import RECIPES as NAMES
from rsjax.data.store import encode_clip
from rsjax.tools.sim.collect import collection_key
from rsjax.tools.sim.episode import EpisodePlan, clip_seed, run_episode
from rsjax.tools.sim.expert import OPEN, Expert, LiftState, Manner
from rsjax.tools.sim.lift import LiftSim
from rsjax.tools.sim.panda import REACH, STEP
from rsjax.tools.sim.recipes.grasps import GROUP, HEIGHT, PAUSE, SHORT, GraspManner, MistakenManner
from rsjax.tools.sim.recipes.plans import RECIPES, held_out_plans, scripted, training_plans

CONFIG = SimConfig(episodes=24, test_episodes=4, frames=3, tracks=20, seed=5)
MIX = replace(CONFIG, recipe=("expert=2", "grasps=2", "driving=1"))
STEPS = 60  # control steps of a clip of 16 frames


def play(sim: LiftSim, plan: EpisodePlan) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns an episode's actions, the gripper's positions before them, and success after them."""
    assert plan.manner is not None
    rng = np.random.default_rng([CONFIG.seed, plan.episode])
    sim.reset(int(rng.integers(2**32)))
    expert = plan.manner.expert(rng)
    actions, gripper, success = [], [], []
    for _ in range(STEPS):
        gripper.append(sim.state.gripper)
        actions.append(expert.act(sim.state))
        sim.step(actions[-1])
        success.append(sim.success)
    return np.array(actions), np.array(gripper), np.array(success)


def short(config: SimConfig, name: str, place: int) -> EpisodePlan:
    """Returns an episode of a recipe; a clip of ``midway`` begins with its third frame at the latest."""
    plan = scripted(config, name, place, f"{place}")
    return replace(plan, lead=min(plan.lead, 2))


def test_the_configuration_names_the_recipes_that_there_are() -> None:
    assert (EXPERT, *RECIPES) == NAMES


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_gives_clips_with_finite_labels_that_depend_on_the_seed_alone(sim: LiftSim, name: str) -> None:
    plan = short(CONFIG, name, 1)
    clip = run_episode(sim, CONFIG, plan)
    assert clip.rgb.shape == (3, 64, 64, 3) and clip.rgb.dtype == np.uint8
    assert clip.depth is not None and clip.depth.shape == (3, 64, 64)
    assert clip.actions.shape == (3, CONFIG.action_dim) and np.abs(clip.actions).max() <= 1
    assert not clip.actions[0].any() and clip.actions[1:].any()
    assert clip.tracks.shape == (20, 3, 2) and clip.visible.shape == (20, 3)
    assert all(np.isfinite(labels).all() for labels in (clip.depth, clip.actions, clip.tracks))
    assert clip.provenance["expert"]["mode"] == name and clip.provenance["difficulty"] == "difficult"
    run_episode(sim, CONFIG, short(CONFIG, name, GROUP))
    again = encode_clip(run_episode(sim, CONFIG, short(CONFIG, name, 1)))
    np.testing.assert_equal(again, encode_clip(clip))
    config = replace(CONFIG, seed=6)
    other = run_episode(sim, config, short(config, name, 1))
    assert not np.array_equal(other.actions, clip.actions)
    rng = np.random.default_rng([CONFIG.seed, plan.episode])
    assert clip_seed(clip.provenance) == int(rng.integers(2**32))


def test_a_clip_that_begins_midway_is_the_end_of_the_whole_episode(sim: LiftSim) -> None:
    plan = replace(scripted(CONFIG, "midway", 1, "1"), lead=2)
    clip = run_episode(sim, CONFIG, plan)
    whole = run_episode(sim, replace(CONFIG, frames=5), replace(plan, lead=0))
    np.testing.assert_array_equal(clip.rgb, whole.rgb[2:])
    np.testing.assert_array_equal(clip.actions[1:], whole.actions[3:])
    assert clip.provenance["window"] == 2 and "window" not in whole.provenance
    leads = [scripted(CONFIG, "midway", place, "1").lead for place in range(40)]
    assert 2 <= min(leads) < 10 and 30 < max(leads) <= 40
    assert {scripted(CONFIG, name, 1, "1").lead for name in RECIPES if name != "midway"} == {0}


def test_grasps_of_a_group_share_start_and_approach_and_about_half_succeed(sim: LiftSim) -> None:
    plans = [scripted(CONFIG, "grasps", place, f"{place}") for place in range(6 * GROUP)]
    success = []
    over_the_cube: list[bool] = []
    for first in range(0, len(plans), GROUP):
        manners = [asdict(plan.manner) for plan in plans[first : first + GROUP]]  # type: ignore[call-overload]
        offsets = [manner.pop("offset") for manner in manners]
        assert all(manner == manners[0] for manner in manners) and len(set(offsets)) == GROUP
        played = [play(sim, plan) for plan in plans[first : first + GROUP]]
        actions, gripper, lifted = (np.stack(each) for each in zip(*played, strict=True))
        parted = np.flatnonzero((actions != actions[0]).any((0, 2)))[0]
        np.testing.assert_array_equal(gripper[:, : parted + 1], gripper[:1, : parted + 1].repeat(GROUP, 0))
        assert (actions[:, : parted + 1, 6] == OPEN).all(), "they part before the fingers close"
        over_the_cube.append(parted > 5)
        assert over_the_cube[-1] or isinstance(plans[first].manner, MistakenManner)
        success.append(lifted[:, -1])
    assert 1 <= sum(over_the_cube) <= 5
    rates = np.mean(success, 0)
    assert 0.35 < rates.mean() < 0.65
    assert rates[0] > 0.8 and rates[-1] < 0.4, "the nearest succeed and the farthest fail"


def test_free_driving_reaches_all_edges_with_open_and_closed_fingers() -> None:
    """Without physics: the gripper is where the actions send it."""
    goals, fingers, toggled, reversed_ = [], [], 0, 0
    for place in range(100):
        plan = scripted(CONFIG, "driving", place, "x")
        assert plan.manner is not None
        expert = plan.manner.expert(np.random.default_rng(place))
        goal = np.array([-0.1, 0.0, 1.0])
        actions = []
        for _ in range(STEPS):
            actions.append(expert.act(LiftState(goal, goal, 0.0, np.array([0, 0, 0.82]), 0.0)))
            goal = np.clip(goal + STEP * actions[-1][:3], *REACH)
            goals.append(goal)
        rows = np.array(actions)
        fingers += rows[:, 6].tolist()
        toggled += (np.diff(rows[:, 6]) != 0).any()
        reversed_ += (rows[:-4, :3] * rows[4:, :3] < -0.2).any()
    assert (np.min(goals, 0) < REACH[0] + 0.02).all() and (np.max(goals, 0) > REACH[1] - 0.02).all()
    assert 0.25 < np.mean(np.array(fingers) == OPEN) < 0.75
    assert toggled > 30 and reversed_ > 20


def test_the_recipes_take_turns_by_their_shares_and_never_meet_held_out_episodes() -> None:
    plans = training_plans(MIX)
    assert [plan.name for plan in plans] == [f"{number:06d}" for number in range(20)]
    kinds = [plan.manner.mode if plan.manner else EXPERT for plan in plans]
    assert Counter(kinds) == {EXPERT: 8, "grasps": 8, "driving": 4}
    assert Counter(kinds[:10]) == {EXPERT: 4, "grasps": 4, "driving": 2}
    assert [plan.episode for plan in plans if not plan.manner] == [n for n, k in enumerate(kinds) if k == EXPERT]
    grasps = [plan.episode for plan in plans if plan.manner and plan.manner.mode == "grasps"]
    assert sorted(Counter(grasps).values()) == [GROUP, GROUP], "groups are whole"
    held_out = {plan.episode for name in RECIPES for plan in held_out_plans(MIX, name, 50)}
    assert not held_out & {plan.episode for name in RECIPES for plan in training_plans(replace(MIX, recipe=(name,)))}


def test_the_default_keeps_its_episodes_and_another_recipe_has_another_key() -> None:
    assert training_plans(CONFIG) == tuple(EpisodePlan(f"{number:06d}", number) for number in range(20))
    assert collection_key(MIX) != collection_key(CONFIG)
    assert collection_key(replace(CONFIG, recipe=("expert",))) == collection_key(CONFIG)


def test_groups_of_grasps_beside_the_cube_differ_in_height_and_their_episodes_do_not() -> None:
    plans = [scripted(CONFIG, "grasps", place, f"{place}") for place in range(100 * GROUP)]
    offsets = np.array([plan.manner.offset for plan in plans]).reshape(100, GROUP, 3)  # type: ignore[union-attr]
    beside = np.abs(offsets[..., :2]).max((1, 2)) > 0
    stops = np.array([getattr(plan.manner, "stops", True) for plan in plans]).reshape(100, GROUP)
    heights = (offsets[..., 2] + SHORT * stops)[beside]
    np.testing.assert_allclose(heights, heights[:, :1].repeat(GROUP, 1), rtol=1e-12)
    low, high = HEIGHT
    assert low <= heights.min() < low + 0.003 and high - 0.003 < heights.max() <= high
    aside = [plan.manner for plan in plans if isinstance(plan.manner, GraspManner)]
    pauses = np.array([manner.pause for manner in aside])
    assert (pauses.min(), pauses.max()) == (0, PAUSE) and 0.3 < np.mean([manner.stops for manner in aside]) < 0.7


def test_the_expert_itself_misses_in_half_of_the_groups_and_half_are_turned() -> None:
    plans = [scripted(CONFIG, "grasps", place, f"{place}") for place in range(200 * GROUP)]
    mistaken = np.array([isinstance(plan.manner, MistakenManner) for plan in plans]).reshape(200, GROUP)
    turns = np.array([plan.manner.turn for plan in plans]).reshape(200, GROUP)  # type: ignore[union-attr]
    distance = np.array([np.hypot(*plan.manner.offset[:2]) for plan in plans]).reshape(200, GROUP)  # type: ignore[union-attr]
    for each in (mistaken, turns):
        assert (each == each[:, :1]).all(), "a group is of one kind"
        assert 0.4 < (each != 0).mean() < 0.6
    assert np.abs(turns).max() < np.pi / 4
    assert 0.09 < distance[mistaken].max() <= 0.1 and 0.09 < distance[~mistaken].max() <= 0.1


def test_a_mistaken_expert_is_the_expert_of_a_cube_that_stands_elsewhere() -> None:
    manner = MistakenManner("grasps", 1.0, 0.1, 0.02, 0, 0.08, (0.05, 0.0, 0.0), 6, (0.0, 0.0, 0.1), -1, turn=0.3)
    values = {name: value for name, value in asdict(manner).items() if name not in ("turn", "offset")}
    right = Expert(Manner(**values, offset=(0.0, 0.0, 0.0)), np.random.default_rng(0))
    wrong = manner.expert(np.random.default_rng(0))
    cube = np.array([0.0, 0.02, 0.82])
    for step in range(40):
        gripper = np.array([-0.1 + 0.01 * min(step, 15), 0.02, 1.0 - 0.01 * min(step, 17)])
        seen = LiftState(gripper, gripper, 0.1, cube, 0.2)
        elsewhere = LiftState(gripper, gripper, 0.1, cube + np.array([0.05, 0, 0]), 0.5)
        np.testing.assert_allclose(wrong.act(seen), right.act(elsewhere), atol=1e-12)
