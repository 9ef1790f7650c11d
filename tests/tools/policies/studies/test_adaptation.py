"""An adaptation of ``debug`` by its command: of a policy, of recorded episodes, killed and resumed, and refused."""

import json
import shutil
import signal
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.config import ComponentConfig, CurriculumStageConfig
from rsjax.config.config_fields import with_values
from rsjax.data.store import open_store
from rsjax.models.load_run import load
from rsjax.tools.policies.config import toy
from rsjax.tools.policies.diffusion_policy import DiffusionPolicy
from rsjax.tools.policies.judges.judge_training import FOLDER
from rsjax.tools.policies.on_policy import FIRST_EPISODE
from rsjax.tools.policies.policy import Policy
from rsjax.tools.policies.run_data import RunData
from rsjax.tools.policies.studies.adaptation import Adaptation, adapted, by_episode, steps_of
from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld
from rsjax.tools.sim.episode import clip_seed
from tests.tools.pipeline.conftest import Commands, command, debug, shared
from tests.tools.policies.toy_worlds import untrained_judge

__all__ = ["command", "debug", "shared"]

QUICK = ("--steps", 4, "--rollouts", 2, "--held-out", 2, "--trials", 2, "--max-steps", 7, "--together", 1)


@dataclass(frozen=True)
class Place:
    """A run with a judge, a policy, and the result of a whole adaptation; only for reading."""

    run: Path
    policy: Path
    out: Path


@pytest.fixture(scope="module")
def place(debug: Path, command: Commands, tmp_path_factory: pytest.TempPathFactory) -> Place:
    folder = tmp_path_factory.mktemp("adapt")
    run = shutil.copytree(debug, folder / "run", symlinks=True)
    untrained_judge(64).save(run / FOLDER)
    demos = RunData(run, command.data).demos("all")
    net = DiffusionPolicy(toy(), demos.image_size, demos.controls, demos.width)
    Policy(net, jax.jit(net.init)(jax.random.key(0)), demos.range).save(folder / "policy")
    command.here("experiments.adapt", run, "--policy", folder / "policy", *QUICK, "--out", folder / "out")
    return Place(run, folder / "policy", folder / "out")


def results(out: Path) -> dict[str, Any]:
    """The results without the place where they lie."""
    content: dict[str, Any] = json.loads((out / "results.json").read_text().replace(str(out), "OUT"))
    return content


def test_the_adapted_run_is_a_run_that_began_with_the_weights_and_both_kinds_of_clips(place: Place) -> None:
    after = load(place.out / "round-1")
    before = load(place.run)
    jax.tree.map(np.testing.assert_array_equal, after.assets.tokenizer, before.assets.tokenizer)
    assert (place.out / "round-1" / "tokens" / "store").resolve() == (place.run / "tokens" / "store").resolve()
    (stage,) = after.config.train.curriculum
    own, new = stage.components
    assert own.store == "" and own.weight == new.weight == 0.5
    tokens = open_store(new.store)
    assert tokens.path.is_relative_to(place.out / "on-policy-1") and tokens.counts() == {"train": 4, "test": 4}
    log = [json.loads(row) for row in (place.out / "round-1" / "world_model" / "log.jsonl").read_text().splitlines()]
    assert log[-1]["step"] == 4
    assert (place.out / "round-1" / "report.html").exists() and (place.out / "round-1" / FOLDER).exists()


def test_the_clips_are_what_the_policy_did(place: Place, command: Commands) -> None:
    data = RunData(place.run, command.data)
    episodes = open_store(place.out / "on-policy-1" / "episodes").source("test")
    with closing(SimulatorWorld.lift(data.simulator, 1)) as world:
        for number in range(2):
            record = episodes[number]
            seed = clip_seed({"seed": data.simulator.seed, "episode": FIRST_EPISODE + number})
            state = world.reset([seed])
            np.testing.assert_array_equal(record["rgb"][0], state.observation["rgb"][0])
            for frame, row in enumerate(record["actions"][1:], 1):
                state = world.step(row[None])
                np.testing.assert_array_equal(record["rgb"][frame], state.observation["rgb"][0])
    assert len(record["rgb"]) == 8


def test_scores_and_success_are_reported_before_and_after(place: Place) -> None:
    found = results(place.out)
    assert [row["name"] for row in found["models"]] == ["before", "round-1"]
    for row in found["models"]:
        scores = json.loads((Path(row["run"].replace("OUT", str(place.out))) / "metrics.json").read_text())
        assert row["own"]["psnr"] == scores["psnr"] and row["on_policy"]["clips"] == 2
    before, after = found["models"]
    for kind in ("own", "on_policy"):
        assert before[kind]["gain"]["value"] == 0
        assert after[kind]["gain"]["value"] == pytest.approx(after[kind]["psnr"] - before[kind]["psnr"])
    assert [row["run"] for row in found["success"]] == ["before", "round-1"]
    text = (place.out / "results.md").read_text()
    assert "| round-1 " in text and "same outcome" in text


def test_clips_of_one_episode_count_once() -> None:
    clips = [{"number": number, "episode": episode} for number, episode in enumerate("abbc")]
    assert by_episode(np.array([1.0, 2.0, 4.0, 5.0]), clips).tolist() == [1.0, 3.0, 5.0]


def test_a_second_round_starts_from_the_first_and_learns_from_both_rounds_episodes(
    place: Place, command: Commands
) -> None:
    data = RunData(place.run, command.data)
    before = place.out / "round-1"
    _, new = load(before).config.train.curriculum[0].components
    config = adapted(data.config, data.clips, [Path(new.store)] * 2, before, Adaptation(rounds=2), 4, 2)
    assert config.train.start_from == config.tokenizer_train.start_from == str(before)
    assert [part.weight for part in config.train.curriculum[0].components] == [0.5, 0.25, 0.25]
    assert config.train.seed == data.config.train.seed + 2


def test_of_its_own_clips_a_run_draws_as_in_the_last_stage_of_its_curriculum(place: Place, command: Commands) -> None:
    data = RunData(place.run, command.data)
    new = place.out / "on-policy-1" / "clips"
    parts = (ComponentConfig(clips=2, weight=3.0), ComponentConfig(clips=1, weight=1.0))
    stages = (CurriculumStageConfig(epochs=9), CurriculumStageConfig(parts, epochs=9, frames=3))
    config = with_values(data.config, {"train.curriculum": stages})
    changed = adapted(config, data.clips, [new], place.run, Adaptation(share=0.2), 7, 1)
    (stage,) = changed.train.curriculum
    assert [part.weight for part in stage.components] == pytest.approx([0.6, 0.2, 0.2]) and stage.frames == 3
    assert [part.clips for part in stage.components] == [2, 1, 0] and stage.components[2].store == str(new)
    assert stage.epochs * (2 + 1 + 4) == 7 * config.train.batch_size


def test_a_call_on_the_episodes_that_is_killed_and_runs_again_gives_the_same_bytes_as_the_policies_whole_call(
    place: Place, command: Commands, tmp_path: Path
) -> None:
    store = place.out / "on-policy-1" / "episodes"
    words = (place.run, "--episodes", store, "--steps", 4, "--out", tmp_path)
    killed = command("tests.tools.policies.killed", *words)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    command.here("experiments.adapt", *words)
    for file in ("on-policy-1/clips/train-00000.array_record", "on-policy-1/clips/test-00000.array_record"):
        assert (tmp_path / file).read_bytes() == (place.out / file).read_bytes()
    params = [load(each / "round-1").params for each in (tmp_path, place.out)]
    jax.tree.map(np.testing.assert_array_equal, *params)
    found = results(tmp_path)
    assert "success" not in found
    assert found["models"] == results(place.out)["models"]
    command.here(
        "experiments.adapt", *words, "--policy", place.policy, "--trials", 2, "--max-steps", 7, "--together", 1
    )
    assert results(tmp_path)["success"] == results(place.out)["success"]  # a policy is measured without a new training
    line = command.refused("experiments.adapt", *words, "--share", 0.4)
    assert "holds an adaptation of another run, to other policies or episodes, or with other settings" in line


def test_what_cannot_be_adapted_is_refused(place: Place, command: Commands) -> None:
    assert "name policies with --policy DIR" in command.refused("experiments.adapt", place.run)
    head = ("--policy", place.policy, *QUICK, "--judge", "head")
    assert "no state heads" in command.refused("experiments.adapt", place.run, *head)


def test_minutes_become_steps_by_the_runs_own_log_and_stay_the_same(place: Place) -> None:
    work: Any = SimpleNamespace(metadata={}, save=lambda **values: work.metadata.update(values))
    settings = Adaptation(minutes=0.5)
    rows = [json.loads(row) for row in (place.run / "world_model" / "log.jsonl").read_text().splitlines()]
    seconds = np.median([row["seconds_per_step"] for row in rows if row.get("seconds_per_step")])
    assert steps_of(place.run, settings, work) == max(1, round(30 / seconds))
    work.metadata["steps"] = 7
    assert steps_of(place.run, settings, work) == 7
