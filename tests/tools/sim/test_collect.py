import errno
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsjax.artifact import make_once
from rsjax.clip import Clip
from rsjax.config import ConfigError, SimConfig
from rsjax.data.store import complete_key, encode, encode_clip, open_store
from rsjax.files import FileError, making
from rsjax.processes import WorkerDied
from rsjax.tools.sim import collect as collect_module
from rsjax.tools.sim import panda as panda_module
from rsjax.tools.sim.collect import CollectError, collect, collection_key
from rsjax.tools.sim.contacts import collect_contacts, contact_splits
from rsjax.tools.sim.episode import EpisodePlan, Simulators, run_episode
from rsjax.tools.sim.lift import LiftSim
from rsjax.tools.sim.recipes.plans import RECIPES, training_plans

CONFIG = SimConfig(episodes=4, test_episodes=1, frames=4, tracks=20, seed=5)


def plan(episode: int) -> EpisodePlan:
    return EpisodePlan(f"{episode:06d}", episode)


def assert_same(left: Clip, right: Clip) -> None:
    for name, value in encode_clip(left).items():
        if name == "provenance":
            assert value | {"depth_range": 0} == getattr(right, name) | {"depth_range": 0}
        else:
            np.testing.assert_array_equal(value, getattr(right, name), err_msg=name)


def test_an_episode_depends_only_on_seed_and_number(sim: LiftSim) -> None:
    clips = [run_episode(sim, CONFIG, plan(episode)) for episode in range(4)]
    assert_same(run_episode(sim, CONFIG, plan(3)), clips[3])
    with LiftSim(image_size=64) as fresh:
        assert_same(run_episode(fresh, CONFIG, plan(3)), clips[3])
    assert not np.array_equal(clips[3].rgb[0], clips[2].rgb[0])
    other = run_episode(sim, replace(CONFIG, seed=6), plan(3))
    assert not np.array_equal(other.actions, clips[3].actions)


def test_computing_each_state_once_changes_no_physics(sim: LiftSim, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = run_episode(sim, CONFIG, plan(2))
    monkeypatch.setattr(panda_module, "compute_states_once", lambda sim: None)
    with LiftSim(image_size=64) as plain:
        other = run_episode(plain, CONFIG, plan(2))
    np.testing.assert_allclose(clip.actions, other.actions, atol=1e-5)
    np.testing.assert_allclose(clip.tracks, other.tracks, atol=1e-5)


def test_a_state_that_comes_back_after_a_reset_is_computed_again(sim: LiftSim) -> None:
    sim.reset(7)
    inner = sim._env.sim
    state, poses = inner.get_state(), sim.body_poses()
    inner.reset()  # forgets all poses
    inner.set_state(state)
    inner.forward()
    np.testing.assert_array_equal(sim.body_poses()[0], poses[0])


def test_collect_resumes_a_mix_of_recipes_and_packs_it(sim: LiftSim, tmp_path: Path) -> None:
    config = replace(CONFIG, recipe=("grasps", "driving"))
    plans = (*training_plans(config), plan(3))  # the test clip is the expert's
    out = tmp_path / "lift"
    partial = tmp_path / "lift.partial"

    def interrupt_after_one(done: int, total: int) -> None:
        assert total == 4
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect(config, out, interrupt_after_one, workers=1)  # a simulator takes seconds to start
    kept = list(partial.glob("*.clip"))
    assert kept
    assert not out.exists()
    # an episode that is there is not simulated again: this one says so
    mark = kept[0]
    marked = int(mark.stem)
    mark.write_bytes(encode(encode_clip(run_episode(sim, config, plans[marked])) | {"task": "marked"}))

    seen: list[int] = []
    collect(config, out, lambda done, total: seen.append(done), workers=1)
    assert seen[0] >= 1
    assert seen[-1] == 4
    assert not partial.exists()
    assert complete_key(out) == collection_key(config)

    store = open_store(out)
    train = store.source("train")
    test = store.source("test")
    assert (len(train), len(test)) == (3, 1)
    clips = [Clip(**record) for record in [*(train[number] for number in range(3)), test[0]]]
    for number, clip in enumerate(clips):
        assert (clip.task == "marked") == (number == marked)
        if number != marked:
            assert_same(run_episode(sim, config, plans[number]), clip)

    actions = np.concatenate([c.actions[1:] for c in clips[:3]])
    np.testing.assert_allclose(store.manifest["action_mean"], actions.mean(0), atol=1e-6)
    np.testing.assert_allclose(store.manifest["action_std"], actions.std(0), atol=1e-6)
    near, far = store.manifest["depth_range"]
    depth = np.stack([c.depth for c in clips[:3] if c.depth is not None])
    assert (near, far) == (depth.min(), depth.max())
    assert clips[3].provenance["depth_range"] == [near, far]
    assert store.manifest["modes"].keys() >= {"grasps", "driving"}

    collect(config, out, lambda done, total: seen.append(-done))
    assert seen[-1] == -4, "already there: nothing to do"

    contacts = collect_contacts(config, store, 1, lambda done, total: None, workers=1)
    assert contacts.splits == contact_splits(config) == tuple(f"contacts_{name}" for name in RECIPES)
    assert contacts.manifest["depth_range"] == store.manifest["depth_range"]
    assert [contacts.source(split)[0]["provenance"]["expert"]["mode"] for split in contacts.splits] == list(RECIPES)
    assert not contact_splits(replace(config, env="metaworld", camera="near", recipe=("expert",)))


def prepared(tmp_path: Path, config: SimConfig, failed: range) -> Path:
    """A collection of which all episodes are done, some of them failed in the simulator."""
    out, partial = tmp_path / "lift", tmp_path / "lift.partial"
    with suppress(KeyboardInterrupt), make_once(partial, collection_key(config), refuse=None):
        raise KeyboardInterrupt
    for i in range(config.episodes):
        clip = Clip(
            rgb=np.zeros((2, 4, 4, 3), np.uint8),
            depth=np.ones((2, 4, 4), np.float32),
            actions=np.full((2, 28), i, np.float32),
            tracks=np.zeros((1, 2, 2), np.float32),
            visible=np.ones((1, 2), bool),
            success=np.array([False, i % 2 == 0]),
            task="lift",
            provenance={"episode": i, "difficulty": "simple", "expert": {"mode": "lift"}},
        )
        if i in failed:
            collect_module._error_file(partial, f"{i:06d}").write_text("ArithmeticError: it diverged")
        else:
            collect_module._clip_file(partial, f"{i:06d}").write_bytes(encode(encode_clip(clip)))
    return out


def test_a_collection_waits_for_the_process_that_makes_the_same_and_uses_its_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, counts = tmp_path / "store", []
    monkeypatch.setattr(collect_module, "choose_gl", lambda: None)
    monkeypatch.setattr(collect_module, "complete_key", lambda path: collection_key(CONFIG) if path.exists() else None)
    first = ExitStack()
    first.enter_context(making(tmp_path / "store.partial", wait=False))

    def finish(line: str) -> None:
        out.mkdir()
        first.close()

    monkeypatch.setattr("rsjax.files.note", finish)
    collect(CONFIG, out, lambda *done: counts.append(done))
    assert counts == [(4, 4)]
    assert list(out.iterdir()) == [] and not (tmp_path / "store.partial").exists()


def test_failed_episodes_are_left_out_and_named(gl: str, tmp_path: Path) -> None:
    config = SimConfig(episodes=20, test_episodes=5)
    out = prepared(tmp_path, config, range(3, 5))
    collect(config, out, lambda done, total: None)
    store = open_store(out)
    assert len(store.source("train")) == 13
    assert len(store.source("test")) == 5
    assert store.manifest["quarantine"] == {f"00000{i}": "ArithmeticError: it diverged" for i in (3, 4)}
    assert store.manifest["success_share"] == pytest.approx(9 / 18)


def test_many_failed_episodes_are_an_error(gl: str, tmp_path: Path) -> None:
    config = SimConfig(episodes=20, test_episodes=5)
    out = prepared(tmp_path, config, range(3))
    with pytest.raises(CollectError, match=r"3 of 20 episodes failed.*it diverged"):
        collect(config, out, lambda done, total: None)
    assert [path.name for path in tmp_path.iterdir()] == [".lift.partial.lock"]


def test_a_split_without_an_episode_left_is_an_error(gl: str, tmp_path: Path) -> None:
    config = SimConfig(episodes=20, test_episodes=1)
    out = prepared(tmp_path, config, range(19, 20))
    with pytest.raises(CollectError) as raised:
        collect(config, out, lambda done, total: None)
    assert "every episode of the split test failed in the simulator, the first one with" in str(raised.value)


def test_episodes_of_another_configuration_are_not_reused(
    gl: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = prepared(tmp_path, CONFIG, range(0))
    assert len(list((tmp_path / "lift.partial").glob("*.clip"))) == 4
    missing = []

    def simulate(config: SimConfig, partial: Path, todo: list[EpisodePlan], *_: object) -> None:
        missing.append(len(todo))
        raise KeyboardInterrupt

    monkeypatch.setattr(collect_module, "_simulate", simulate)
    with pytest.raises(KeyboardInterrupt):
        collect(replace(CONFIG, seed=7), out, lambda done, total: None)
    assert missing == [4]
    assert not list((tmp_path / "lift.partial").glob("*.clip"))


def test_a_simulator_failure_costs_one_episode_but_a_full_disk_stops(
    sim: LiftSim, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def raising(error: Exception) -> None:
        def run(*_: object) -> None:
            raise error

        monkeypatch.setattr(collect_module, "run_episode", run)

    simulators = Simulators(CONFIG)
    simulators._sim = sim
    raising(ArithmeticError("it diverged"))
    collect_module._work(simulators, CONFIG, tmp_path, plan(2))
    assert (tmp_path / "000002.error").read_text() == "ArithmeticError: it diverged"
    for error in (OSError(errno.ENOSPC, "No space left on device"), ConfigError("sim.camera is wrong")):
        raising(error)
        with pytest.raises(type(error)):
            collect_module._work(simulators, CONFIG, tmp_path, plan(3))
    assert not (tmp_path / "000003.error").exists()


def test_an_episode_that_kills_two_workers_stops_and_keeps_the_others(
    gl: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_items(
        make: object, items: list[EpisodePlan], workers: int, settle: Callable[[EpisodePlan, WorkerDied], None]
    ) -> None:
        settle(items[0], WorkerDied())

    monkeypatch.setattr(collect_module, "run_items", run_items)
    with pytest.raises(CollectError, match=r"died over episode 0.*fewer runtime.workers \(now 1\)"):
        collect(CONFIG, tmp_path / "lift", lambda done, total: None, workers=1)
    assert (tmp_path / "lift.partial").exists()


def test_full_disk_is_one_clear_line(gl: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(collect_module, "_simulate", full)
    with pytest.raises(FileError, match=r"lift.partial: the disk is full; free some space"):
        collect(CONFIG, tmp_path / "lift", lambda done, total: None)


def test_unknown_camera_is_named(gl: str) -> None:
    with pytest.raises(ConfigError, match=r"'agent'.*agentview"):
        LiftSim(camera="agent")
