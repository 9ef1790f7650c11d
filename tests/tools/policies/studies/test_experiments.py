"""The comparisons of policies, with policies that need no training in worlds of one dot."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsjax.errors import UserError
from rsjax.evaluation.statistics import share_difference
from rsjax.tools.policies.config import toy
from rsjax.tools.policies.run_data import named
from rsjax.tools.policies.studies import improvement
from rsjax.tools.policies.studies import policy_evaluation as comparison
from rsjax.tools.policies.studies import policy_learning as learning
from rsjax.tools.policies.studies.improvement import Improvement, improve, mixed
from rsjax.tools.policies.studies.policy_evaluation import compare
from rsjax.tools.policies.studies.policy_learning import Learning, claims, difference, learn
from rsjax.tools.policies.studies.trials import Trials, episode_file, first_frames, replayed, save_arrays, try_policy
from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld
from tests.tools.policies.toy import CONTROLS, WIDTH, demos
from tests.tools.policies.toy_worlds import ToyPolicy, ToySimulator, imagined, simulated
from tests.tools.policies.toy_worlds import judge as toy_judge

TRIALS = Trials(episodes=10, max_steps=4, together=5, videos=1)  # the dot begins in columns 3 … 4, 0 … 4, 0 … 2


def squeezed(path: Path) -> str:
    """A Markdown file's text without the spaces that align its columns."""
    return " ".join(path.read_text().split())


def test_each_cell_learns_from_its_demonstrations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained: dict[str, tuple[int, int]] = {}

    def train(config: Any, source: Any, directory: Path, *, seed: int, name: str) -> ToyPolicy:
        trained[directory.name] = (len(source), config.train.steps)
        return ToyPolicy(0.8 + 0.05 * len(source))

    monkeypatch.setattr(learning, "train_policy", train)
    settings, out = Learning((1, 4), seeds=2), tmp_path / "out"
    results = learn(settings, toy(), demos(4), demos(5), simulated(5), TRIALS, out)
    per_seed = {name.removesuffix("-seed0"): each for name, each in trained.items() if name.endswith("seed0")}
    assert per_seed == {
        "synthetic-1": (1, 4),
        "synthetic-4": (4, 4),
        "real-1": (1, 4),
        "real-4": (4, 4),
        "real-4-repeated": (4, 8),
        "real-4-synthetic-4": (8, 8),
    }
    assert len(trained) == 12 and json.loads((out / "results.json").read_text()) == results
    success = {row["name"]: np.mean(row["success"]) for row in results["rows"]}
    assert success["synthetic-1"] == success["real-1"] < success["synthetic-4"] == 0.6
    found = {claim["claim"]: claim for claim in results["claims"]}
    as_good = found["4 synthetic as good as 4 real"]
    assert (as_good["value"], as_good["verdict"]) == (0, "cannot tell"), "20 trials each are too few for 10 %"
    assert found["more synthetic is better"]["value"] == pytest.approx(success["synthetic-4"] - success["synthetic-1"])
    assert "| synthetic-4 | 4 synthetic | 60 % |" in squeezed(out / "results.md")
    assert (out / "success.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(UserError, match="9 demonstrations are asked for, there are 4"):
        learn(Learning((9,)), toy(), demos(4), demos(9), simulated(5), TRIALS, tmp_path / "more")
    with pytest.raises(UserError, match="no cell .real-7.; there are synthetic-1"):
        Learning((1,), cells=("real-7",)).chosen()


def test_without_a_difference_nothing_is_claimed() -> None:
    rows: Any = [
        {"name": f"{kind}-8", "real": 8 * (kind == "real"), "synthetic": 8 * (kind != "real"), "steps": 1}
        | {"success": [[kind == "real", kind != "real"] * 6]}
        for kind in ("synthetic", "real")
    ]
    assert [claim["verdict"] for claim in claims(rows, 8)] == ["cannot tell"]
    for rate, verdict in ((0, "cannot tell"), (0.9, "holds")):  # where nothing succeeds, nothing is as good as another
        alike = [row | {"success": [[number < 200 * rate for number in range(200)]]} for row in rows]
        assert [claim["verdict"] for claim in claims(alike, 8)] == [verdict]


def test_trainings_that_differ_widen_the_interval_and_one_training_has_that_of_its_trials() -> None:
    alike = np.tile([1.0, 1.0, 0.0, 0.0, 0.0], (3, 20))
    better = alike.copy()
    better[:, 2::5] = 1
    uneven = better.copy()
    uneven[0, 2::5] = 0  # the first training gained nothing
    assert difference(better, alike) == share_difference(better, alike)  # the seeds agree
    assert difference(uneven[:1], alike[:1]) == share_difference(uneven[:1], alike[:1])
    plain, wide = share_difference(uneven, alike), difference(uneven, alike)
    assert wide.value == plain.value and wide.low < 0 < plain.low < plain.high < wide.high  # type: ignore[operator]


def test_models_are_compared_with_the_simulator_and_their_mistakes_are_told_from_other_actions(tmp_path: Path) -> None:
    policies: Any = {f"speed-{speed}": ToyPolicy(speed) for speed in (0.1, 0.8, 0.9, 1.0)}
    paces = {"true": 1.0, "slow": 0.5, "fast": 3.0}
    models: Any = {name: partial(imagined, 5, pace=pace) for name, pace in paces.items()}
    results = compare(policies, simulated(5), models, TRIALS, tmp_path)
    same, slow, fast = results["runs"]
    assert same["run"] == "true" and same["same_outcome"] == 1
    assert same["pearson"]["value"] == pytest.approx(1) and same["r2_identity"] == same["r2_prediction"] == 1
    assert (same["mmrv"], same["bias"]) == (0, 0)
    assert slow["bias"] < 0 and slow["mmrv"] >= 0 and slow["same_outcome"] < 1
    assert {path.name for path in (tmp_path / "videos").iterdir()} == {
        f"{run}-{name}-00.mp4" for run in models for name in policies
    }
    text = squeezed(tmp_path / "results.md")
    assert "R² of y = x is 1 - Σ(y - x)² / Σ(y - ȳ)²" in text
    assert "| true | 1.000 |" in text and "| speed-1.0 | the simulator | 60 % |" in text
    assert all(each["corrected"]["worth"] == 10 for each in same["policies"].values())  # every trial is paired
    assert (tmp_path / "scatter.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((tmp_path / "results.json").read_text()) == results

    # The actions of an episode in a model, replayed in the simulator, tell what the model mistakes.
    assert all(each["replayed"] == each["simulator"] == each["world_model"] for each in same["policies"].values())
    # In the fast world the dot arrives by actions that do not take it there in the simulator.
    of = ("world_model", "replayed", "simulator")
    rates = np.array([[np.mean(each[kind]) for kind in of] for each in fast["policies"].values()])
    assert (rates[1:, 0] > rates[1:, 1]).all()
    model, replays, true = rates.mean(0)
    shares = " | ".join(f"{100 * rate:.0f} %" for rate in (model, replays, true))
    assert f"| fast | all | {shares} | {model - replays:+.3f} | {replays - true:+.3f} |" in text
    again = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("made.json")}
    assert len([path for path in again if path.parent.name == "replayed"]) == 12
    assert compare(policies, simulated(5), models, TRIALS, tmp_path) == results
    assert again == {path: path.stat().st_mtime_ns for path in again}, "something is run again"


class Coasting(ToySimulator):
    """Its dot moves on by itself."""

    def step(self, control: np.ndarray) -> None:
        super().step(control)
        self.place += 0.8 / CONTROLS


def test_a_replay_does_not_depend_on_the_episodes_beside_it(tmp_path: Path) -> None:
    trials = Trials(episodes=2, max_steps=12, together=2)
    for number, steps in enumerate((2, 10)):
        save_arrays(
            episode_file(tmp_path, number), actions=np.full((1 + steps, CONTROLS * WIDTH), 0.3 / CONTROLS, np.float32)
        )
    found = {}
    for count in (1, 2):
        simulators: Any = [Coasting() for _ in range(count)]
        world = SimulatorWorld(simulators, CONTROLS, WIDTH)
        found[count] = replayed(world, tmp_path, trials, tmp_path / f"{count} at a time", "toy")
    assert found[1] == found[2] == [False, True]
    episode_file(tmp_path, 1).unlink()
    with pytest.raises(UserError) as raised:
        replayed(world, tmp_path, trials, tmp_path / "replayed", "toy")
    assert "episode-01.npz: not there" in str(raised.value)
    assert f"delete {tmp_path} to run them again" in str(raised.value)


def test_trials_that_stop_within_a_group_go_on_as_if_they_had_not(tmp_path: Path) -> None:
    policy: Any = ToyPolicy(1.0)

    def tried(folder: Path) -> Any:
        return try_policy(policy, simulated(5), TRIALS.seeds, TRIALS, folder, "toy", save_frames=10)

    whole = tried(tmp_path / "whole")
    blocked = episode_file(tmp_path / "stopped", 7)  # of the second group
    blocked.mkdir(parents=True)
    with pytest.raises((OSError, UserError)):
        tried(tmp_path / "stopped")
    blocked.rmdir()
    assert tried(tmp_path / "stopped") == whole
    assert len(whole.success) == len(whole.uninterpretable) == 10
    names = [{path.name for path in (tmp_path / name).iterdir()} for name in ("whole", "stopped")]
    assert names[0] == names[1]


def test_more_imagined_trials_than_true_ones_correct_the_rate_by_the_pairs(tmp_path: Path) -> None:
    policies: Any = {f"speed-{speed}": ToyPolicy(speed) for speed in (0.1, 0.8, 0.9, 1.0)}
    models: Any = {"true": lambda: imagined(5), "slow": lambda: imagined(5, pace=0.9)}
    training = {name: name[-1] for name in policies}
    likes = {"true": "true", "slow": "true"}
    results = compare(
        policies, simulated(5), models, TRIALS, tmp_path, imagined=40, training=training, replicates=likes
    )
    same, slow = results["runs"]
    for each in same["policies"].values():
        assert (len(each["simulator"]), len(each["world_model"])) == (10, 40)
        assert each["corrected"]["trials"] == 10 and 10 <= each["corrected"]["worth"] < 40
    fast = same["policies"]["speed-1.0"]
    assert fast["corrected"]["worth"] > 15 and fast["corrected"]["rate"]["value"] == pytest.approx(0.6)
    assert same["same_outcome"] == 1 > slow["same_outcome"]
    for name, each in slow["policies"].items():  # the correction moves the rate towards the true one
        rates = [np.mean(same["policies"][name]["simulator"]), each["corrected"]["rate"]["value"]]
        assert abs(rates[1] - rates[0]) <= abs(np.mean(each["world_model"]) - rates[0])
    (group,) = results["trainings"]
    assert group["runs"] == ["true", "slow"] and group["policies"] == 4
    assert group["pearson"]["low"] < group["pearson"]["value"] < group["pearson"]["high"]
    assert "| true, slow | 4 |" in squeezed(tmp_path / "results.md")
    assert len(list((tmp_path / "true" / "speed-1.0").glob("episode-*.npz"))) == 10  # those with a true episode
    with pytest.raises(UserError) as error:
        compare(policies, simulated(5), models, TRIALS, tmp_path, imagined=9)
    assert str(error.value) == "--imagined is 9; it must be at least --episodes, which is 10"


def test_what_another_judge_model_or_policy_made_is_not_taken_for_ones_own(tmp_path: Path) -> None:
    def blind(frames: np.ndarray) -> np.ndarray:
        """Finds frames with the dot in column 5 or farther uninterpretable, and the others no success."""
        far = frames[:, -1, 7, :, 0].argmax(-1) >= 5
        return np.stack([np.zeros_like(far), ~far, far], -1).astype(float)

    policies: Any = {"a": ToyPolicy(0.8), "b": ToyPolicy(0.8)}
    compare(policies, simulated(5), {"run": lambda: imagined(5)}, TRIALS, tmp_path)
    for world in (imagined(5, judge=blind), imagined(5, pace=0.5)):
        with pytest.raises(
            UserError, match=r"run/a: holds trials of .* another policy, simulator, world model or judge"
        ):
            compare(policies, simulated(5), {"run": lambda world=world: world}, TRIALS, tmp_path)  # type: ignore[misc]
    with pytest.raises(UserError, match=r"simulator/b: holds trials of"):
        compare({**policies, "b": ToyPolicy(0.9)}, simulated(5), {}, TRIALS, tmp_path)  # type: ignore[dict-item]
    results = compare(policies, simulated(5), {"run": lambda: imagined(5, judge=blind)}, TRIALS, tmp_path / "new")
    (row,) = results["runs"]
    assert row["uninterpretable"] == 1 and not any(row["policies"]["a"]["world_model"])
    assert row["pearson"]["value"] is None and row["policies"]["a"]["clipped"] == {"simulator": 0, "world_model": 0}
    text = (tmp_path / "new" / "results.json").read_text()
    assert "NaN" not in text and json.loads(text) == results
    table = squeezed(tmp_path / "new" / "results.md")
    assert "| run | – | no variation | – |" in table
    assert "| a | run | 0 % | 0 … 28 % | 20 % | 6 … 51 % | 0 | 100 % | 0 |" in table
    assert "The judge has no validation.json" in table
    assert toy_judge.__qualname__ == "judge"  # the keys of functions are their names


def test_checkpoints_go_from_the_first_steps_to_the_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stopped: list[int] = []

    def train(config: Any, source: Any, directory: Path, *, name: str, seed: int, stops: list[int]) -> ToyPolicy:
        stopped.extend(stops)
        return ToyPolicy(config.train.steps + seed)

    monkeypatch.setattr(comparison, "train_policy", train)
    monkeypatch.setattr(comparison, "load_policy", lambda place: ToyPolicy(float(place.name.removeprefix("at-"))))
    config = replace(toy(), train=replace(toy().train, steps=1000))
    found: Any = comparison.checkpoints(config, demos(), tmp_path, 8)
    assert stopped == [10, 30, 60, 120, 250, 500, 750]
    assert [(name, policy.speed) for name, policy in found.items()] == [(f"step-{n}", n) for n in (*stopped, 1000)]
    assert not capsys.readouterr().out
    trained, training = comparison.trained_policies(config, demos(), tmp_path, 2, trainings=2)
    assert {name: policy.speed for name, policy in trained.items()} == {  # type: ignore[attr-defined]
        "step-10": 10,
        "step-1000": 1000,
        "seed1-step-10": 10,
        "seed1-step-1000": 1001,
    }
    assert [*training.values()] == ["policy", "policy", "policy-seed1", "policy-seed1"]
    few = comparison.checkpoints(replace(config, train=replace(config.train, steps=20)), demos(), tmp_path, 8)
    assert len(few) == 6
    assert "20 training steps have 6 stages, not 8; more steps, or fewer checkpoints" in capsys.readouterr().out


@pytest.fixture
def learnt(monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[Any, float]]:
    """Demonstrations and learning rate of each training, which makes policies faster by imagined ones alone."""
    found: dict[str, tuple[Any, float]] = {}

    def train(config: Any, source: Any, directory: Path, *, name: str, seed: int, start: ToyPolicy) -> ToyPolicy:
        found[name] = (source, config.train.optimizer.learning_rate)
        assert config.train.steps == 7
        return ToyPolicy(start.speed + (0.1 if name.endswith("imagined") else 0), replace(start.model, config=config))

    monkeypatch.setattr(improvement, "train_policy", train)
    return found


def test_imagined_successes_are_learnt_from(tmp_path: Path, learnt: dict[str, tuple[Any, float]]) -> None:
    settings = Improvement(rounds=2, imagined=10, max_steps=4, steps=7, share=0.5, learning_rate=0.5)
    starts = first_frames(simulated(5), list(range(10)), tmp_path / "starts.npz")
    draws: list[list[int]] = []
    model = imagined(5, draws=draws)
    inputs: Any = (ToyPolicy(0.8), demos(3), starts, model, simulated(5), settings, TRIALS, tmp_path)
    results = improve(*inputs)
    assert draws[0] == [0, 1, 2, 3, 4] and draws[2] == [10, 11, 12, 13, 14]  # a second round has other draws
    kept = [row["kept"] for row in results["rounds"]]
    assert kept == [2, 4]  # of columns 0 … 4 twice, those from which 4 steps at this speed come to column 10
    assert {name: len(source) for name, (source, _) in learnt.items()} == {
        "round 1 imagined": 4,
        "round 1 control": 3,
        "round 2 imagined": 8,
        "round 2 control": 3,
    }
    assert {rate for _, rate in learnt.values()} == {0.5 * toy().train.optimizer.learning_rate}  # in every round
    assert (
        np.mean(results["rounds"][-1]["imagined"])
        > np.mean(results["before"])
        == np.mean(results["rounds"][-1]["control"])
    )
    assert "| 2 | 10 | 4 | 0 % | imagined | 60 % |" in squeezed(tmp_path / "results.md")
    count = len(draws)
    assert improve(*inputs) == results and len(draws) == count  # nothing is imagined again
    other: Any = (*inputs[:3], imagined(5, pace=0.5), *inputs[4:])  # a model of other weights
    with pytest.raises(UserError) as refused:
        improve(*other)
    assert "episodes: holds imagined episodes of other" in str(refused.value)
    assert improve(*inputs) == results and len(draws) == count  # nothing was lost


def test_imagined_episodes_may_follow_the_old_demonstrations(
    tmp_path: Path, learnt: dict[str, tuple[Any, float]]
) -> None:
    settings = Improvement(rounds=1, imagined=10, max_steps=4, steps=7, share=0, follow_demos=True)
    starts = first_frames(simulated(5), list(range(10)), tmp_path / "starts.npz")
    still: Any = ToyPolicy(0)
    inputs: Any = (starts, imagined(5), simulated(5), settings, TRIALS, tmp_path)
    results = improve(still, demos(2), *inputs)
    assert results["settings"]["follow_demos"] and results["rounds"][0]["kept"] == 10  # none begins in column 0 or 1
    made = learnt["round 1 imagined"][0]
    first = next(record for record in made.records if len(record["rgb"]) == 5)  # it begins in column 2 or 3
    column = int(first["rgb"][0, 7, :, 0].argmax())
    np.testing.assert_array_equal(first["rgb"], demos(2)[column - 2]["rgb"][1:6])
    np.testing.assert_array_equal(first["actions"][1:], demos(2)[column - 2]["actions"][2:6])
    with pytest.raises(UserError) as refused:
        improve(still, demos(5), *inputs)
    assert "all first frames are those of demonstrations" in str(refused.value)


def test_old_demonstrations_are_the_share_that_is_asked_for() -> None:
    made: Any = demos(6).records
    for share, count in ((0.0, 6), (0.5, 12), (0.75, 24)):
        assert len(mixed(demos(4), made, share, 0)) == count


def test_runs_are_named_by_what_tells_them_apart() -> None:
    assert list(named([Path("/a/runs/tiny")])) == ["tiny"]
    assert list(named([Path("/a/tiny/s0"), Path("/a/genie/s0")])) == ["tiny-s0", "genie-s0"]
    assert list(named([Path("/a/runs/simulator")])) == ["runs-simulator"]  # results have a folder of that name
    with pytest.raises(UserError, match="are the same"):
        named([Path("/a"), Path("/a")])
