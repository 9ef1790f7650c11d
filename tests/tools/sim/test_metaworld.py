"""Meta-World as a simulator, and scenes that training never sees, at toy scale."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsjax.clip import Clip
from rsjax.config import ConfigError, SimConfig, presets
from rsjax.config.metaworld import ML10, ML10_UNSEEN, ML45_UNSEEN, SIMPLE, TASKS
from rsjax.data.store import encode_clip, open_store
from rsjax.tools.sim import collect as collect_module
from rsjax.tools.sim.collect import collect, collection_key
from rsjax.tools.sim.episode import EpisodePlan, Simulators, run_episode, task_of
from rsjax.tools.sim.lift import LiftSim
from rsjax.tools.sim.metaworld import Expert, Manner, MetaworldSim
from rsjax.tools.sim.scenery import SEEN, Variation
from rsjax.tools.sim.unseen import collect_unseen

CONFIG = SimConfig(
    episodes=3,
    test_episodes=1,
    frames=3,
    control_steps=7,
    image_size=32,
    camera="near",
    tracks=64,
    seed=5,
    env="metaworld",
    tasks=("drawer-close",),
    unseen_tasks=("drawer-open",),
)
DRAWER = EpisodePlan("x", 1, "drawer-close")


@pytest.fixture(scope="module")
def drawer(gl: str) -> Iterator[MetaworldSim]:
    pytest.importorskip("metaworld", reason="Meta-World is not installed")
    with MetaworldSim("drawer-close", image_size=32) as sim:
        yield sim


def arrays(clip: Clip) -> dict[str, Any]:
    return {name: value for name, value in encode_clip(clip).items() if isinstance(value, np.ndarray)}


def test_an_episode_depends_only_on_seed_and_number(drawer: MetaworldSim) -> None:
    first = run_episode(drawer, CONFIG, DRAWER)
    other = run_episode(drawer, CONFIG, replace(DRAWER, episode=2, change="camera"))
    assert not np.array_equal(first.actions, other.actions)
    with MetaworldSim("drawer-close", image_size=32) as fresh:
        np.testing.assert_equal(arrays(run_episode(fresh, CONFIG, DRAWER)), arrays(first))
    np.testing.assert_equal(arrays(run_episode(drawer, CONFIG, DRAWER)), arrays(first))


def test_actions_are_what_led_to_the_frame(drawer: MetaworldSim) -> None:
    """Replaying the stored actions from the same start gives the same pictures, places and successes."""
    clip = run_episode(drawer, CONFIG, DRAWER)
    assert clip.actions.shape == (3, CONFIG.action_dim) and not clip.actions[0].any()
    drawer.reset(int(np.random.default_rng([CONFIG.seed, DRAWER.episode]).integers(2**32)))
    for t in range(CONFIG.frames):
        for action in clip.actions[t].reshape(-1, 4) if t else ():
            drawer.step(action)
        view = drawer.render()
        np.testing.assert_array_equal(view.rgb, clip.rgb[t])
        assert clip.depth is not None
        np.testing.assert_array_equal(view.depth, clip.depth[t])
        assert drawer.success == clip.success[t]
        gripper, _ = drawer.camera.project(drawer.places["gripper"])
        np.testing.assert_allclose(clip.provenance["objects"]["gripper"][t], gripper)
    assert clip.visible[:, 0].all()
    assert clip.provenance["difficulty"] == "simple"
    frames = clip.rgb.astype(int)
    assert (np.abs(np.diff(frames, axis=0)).max(-1) > 16).mean((1, 2)).min() > 0.01, "every frame differs visibly"


def test_depth_camera_and_bodies_agree(drawer: MetaworldSim) -> None:
    """The drawer's pixels, unprojected with their depth, lie around the drawer, and move with it when it is pushed."""
    drawer.reset(3)
    size = 32
    rows, columns = np.nonzero(np.isin(drawer.segment(), drawer.object_bodies))
    assert len(rows) > 10
    xy = np.stack([columns, rows], -1) / size + 0.5 / size
    points = drawer.camera.unproject(xy, drawer.render().depth[rows, columns].astype(float))
    assert np.linalg.norm(points - drawer.places["object"], axis=1).max() < 0.35
    before = drawer.places["object"]
    expert = Expert(drawer.policy, Manner("expert", 0.0, 0, -1), np.random.default_rng(0))
    for _ in range(80):
        drawer.step(expert.act(drawer.state))
    assert drawer.success, "the expert without noise succeeds"
    assert drawer.places["object"][1] > before[1] + 0.1


@pytest.mark.parametrize("name", ["lift", "metaworld"])
def test_what_is_unseen_changes_the_looks_and_nothing_else(name: str, request: pytest.FixtureRequest) -> None:
    sim, config, plan = {
        "lift": ("sim", replace(SimConfig(frames=2, tracks=20), seed=1), EpisodePlan("x", 0)),
        "metaworld": ("drawer", replace(CONFIG, frames=2), DRAWER),
    }[name]
    sim = request.getfixturevalue(sim)
    seen, camera, color, again = (
        run_episode(sim, config, replace(plan, change=change)) for change in (None, "camera", "color", None)
    )
    for clip in (camera, color, again):
        np.testing.assert_array_equal(clip.actions, seen.actions)
        np.testing.assert_array_equal(clip.success, seen.success)
    np.testing.assert_equal(arrays(again), arrays(seen))
    assert color.depth is not None and camera.depth is not None and seen.depth is not None
    np.testing.assert_array_equal(color.depth, seen.depth)
    changed = (color.rgb != seen.rgb).any(-1)
    assert 0.005 < changed.mean() < 0.3, "the objects alone have other colours"
    assert np.abs(camera.depth - seen.depth).mean() > 0.02
    assert color.provenance["unseen"]["what"] == "color" and "unseen" not in seen.provenance


def test_a_camera_that_turns_keeps_looking_at_the_same_point(sim: LiftSim) -> None:
    sim.reset(0)
    here = sim.camera
    forward = -here.rotation[:, 2]
    pivot = here.position + forward * ((np.array([0, 0, 0.85]) - here.position) @ forward)
    sim.reset(0, Variation(yaw=20, pitch=5))
    there = sim.camera
    xy, depth = there.project(pivot)
    np.testing.assert_allclose(xy, 0.5, atol=1e-6)
    assert depth == pytest.approx(np.linalg.norm(here.position - pivot))
    assert there.position[2] > here.position[2], "pitch is upwards"
    flat = [np.arctan2(*(camera.position - pivot)[[1, 0]]) for camera in (here, there)]
    assert np.degrees(flat[1] - flat[0]) == pytest.approx(20)
    sim.reset(0, SEEN)
    np.testing.assert_array_equal(sim.camera.position, here.position)


def test_stores_of_seen_and_unseen_clips(gl: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("metaworld", reason="Meta-World is not installed")

    def simulate(config: SimConfig, partial: Path, todo: list[EpisodePlan], *_: object) -> None:
        simulators = Simulators(config)
        for plan in todo:
            collect_module._work(simulators, config, partial, plan)
        simulators.close()

    monkeypatch.setattr(collect_module, "_simulate", simulate)  # in this process
    config = replace(CONFIG, frames=2, control_steps=1)
    out = tmp_path / "clips"
    collect(config, out, lambda done, total: None)
    clips = open_store(out)
    unseen = collect_unseen(config, clips, 1, lambda done, total: None)
    assert unseen.splits == ("unseen_task", "unseen_camera", "unseen_color")
    assert unseen.manifest["unseen"]["unseen_task"] == {"tasks": ["drawer-open"]}
    for name in ("depth_range", "action_mean", "action_std"):
        assert unseen.manifest[name] == clips.manifest[name]
    test = clips.source("test")[0]
    for split in unseen.splits[1:]:
        same = unseen.source(split)[0]
        np.testing.assert_array_equal(same["actions"], test["actions"])
        assert not np.array_equal(same["rgb"], test["rgb"])
    assert unseen.source("unseen_task")[0]["task"] == "drawer-open"
    assert clips.labels("train").of(0) == {"task": "drawer-close", "difficulty": "simple"}
    with pytest.raises(ConfigError, match=r"2 unseen clips .* gives 1"):
        collect_unseen(config, clips, 2, lambda done, total: None)


def test_lift_keeps_its_key() -> None:
    """It is the name of the store in README and docs: who changes episodes changes it there too."""
    assert collection_key(presets.roboscape_tiny().sim) == "bbe30706a6a29fa8"


def test_every_task_comes_equally_often() -> None:
    config = presets.multitask().sim
    first = config.episodes - config.test_episodes
    counts = np.unique([task_of(config, i) for i in range(first, config.episodes)], return_counts=True)
    assert counts[0].tolist() == sorted(ML10) and set(counts[1]) == {10}
    assert len({task_of(config, i) for i in range(first, config.episodes, 2)}) == 10, "also in every other one"


def test_the_tables_are_those_of_metaworld() -> None:
    table = pytest.importorskip("metaworld.env_dict", reason="Meta-World is not installed")

    def names(split: Any) -> list[str]:
        return sorted(name.removesuffix("-v3") for name in split)

    assert names(table.ALL_V3_ENVIRONMENTS) == list(TASKS)
    assert len(SIMPLE) == 28 and len(TASKS) == 50
    assert names(table.ML10_V3["train"]) == sorted(ML10) and names(table.ML10_V3["test"]) == sorted(ML10_UNSEEN)
    assert names(table.ML45_V3["test"]) == sorted(ML45_UNSEEN)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"tasks": ("drawer-opn",)}, r"sim.tasks names 'drawer-opn', no task of Meta-World.*drawer-open"),
        ({"unseen_tasks": ("drawer-close",)}, r"sim.unseen_tasks has drawer-close, which sim.tasks trains on"),
        ({"camera": "agentview"}, r"agentview.*does not have"),
        ({"env": "lift"}, r"sim.tasks names 'drawer-close', but sim.env is lift"),
    ],
)
def test_impossible_tasks_are_named(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(CONFIG, **fields)
    assert not set(replace(CONFIG, tasks=("door-lock",), unseen_tasks=()).held_out_tasks) & {"door-lock"}
