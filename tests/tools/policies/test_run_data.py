from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rsjax.config import Config, presets, to_dict
from rsjax.data.codec import Record
from rsjax.errors import UserError
from rsjax.files import write_json
from rsjax.tools.policies.demos import is_demo
from rsjax.tools.policies.policy import check_fits
from rsjax.tools.policies.run_data import RunData, replicates, training_of
from rsjax.tools.sim.episode import WINDOW
from tests.tools.policies.toy_worlds import untrained_judge


def run(path: Path, config: Config, trained: bool = True) -> RunData:
    write_json(path / "config.json", to_dict(config))
    if trained:
        (path / "world_model" / "weights").mkdir(parents=True)
    return RunData(path)


def test_runs_in_which_no_policy_can_act_are_named_before_any_training(tmp_path: Path) -> None:
    config = presets.debug()
    first = run(tmp_path / "first", config)
    first.check_world(first)
    run(tmp_path / "genie", config.with_family("genie")).check_world(first)
    run(tmp_path / "irasim", config.with_family("irasim")).check_world(first)
    without = config.with_family("genie")
    without = replace(without, model=replace(without.model, action_encoder="none"))  # type: ignore[call-arg]
    still = run(tmp_path / "still", without)
    for act in (lambda: still.check_world(first), lambda: still.world(5)):
        with pytest.raises(UserError, match=r"still: the model takes no actions \(family 'genie'\)"):
            act()
    longer = replace(config.sim, control_steps=config.sim.control_steps + 1)
    small = run(tmp_path / "small", replace(config, sim=longer))
    with pytest.raises(UserError, match=r"small: frames of 64 pixels and actions of 35 .*first has 64 and 28"):
        small.check_world(first)
    double = run(tmp_path / "double", replace(config, sim=replace(config.sim, second_view="wrist")))
    with pytest.raises(UserError) as refused:
        double.check_world(first)
    assert "the model reads a second view (sim.second_view)" in str(refused.value)
    headless = run(tmp_path / "headless", config)
    headless.check_world(first, first.run / "judge")
    with pytest.raises(UserError) as refused:
        headless.check_world(first, Path("head"))
    assert "headless" in str(refused.value)
    with pytest.raises(UserError, match="new: its world model is not trained yet"):
        run(tmp_path / "new", config, trained=False).check_world(first)


def test_frames_and_actions_of_other_sizes_are_named() -> None:
    check_fits((64, 28), presets.debug().clips, "policy")
    with pytest.raises(UserError) as refused:
        check_fits((64, 7), presets.debug().clips, "policy")
    assert str(refused.value).endswith("frames of 64 pixels and actions of 7 numbers; the run's clips have 64 and 28")


def test_episodes_start_and_demonstrations_begin_as_episodes_do(tmp_path: Path) -> None:
    def clip(window: int, success: bool) -> Record:
        frames = np.full((2, 4, 4, 3), window, np.uint8)
        return {"rgb": frames, "depth": None, "provenance": {WINDOW: window}, "success": np.array([False, success])}

    clips = [clip(7, True), clip(0, True), clip(0, False)]
    clips[2]["rgb"][0] = 1
    pair = [*clips, clip(0, True)]
    data = run(tmp_path / "run", presets.debug())
    vars(data)["clips"] = SimpleNamespace(source=lambda split: pair)
    assert [(start.clip, start.rgb.max()) for start in data.first_frames(9)] == [(1, 0), (2, 1)]
    assert [start.clip for start in data.first_frames(1)] == [1]
    assert [is_demo(each, "success", True) for each in clips] == [False, True, False]
    assert [is_demo(each, "success", False) for each in clips] == [False, True, True]
    assert all(is_demo(each, "all", True) for each in clips)


def test_a_judge_of_frames_of_another_size_is_named(tmp_path: Path) -> None:
    first = run(tmp_path / "first", presets.debug())
    for side in (60, 64):  # networks with parameters of equal shapes
        untrained_judge(side).save(tmp_path / f"judge-{side}")
    first.judge(tmp_path / "judge-64")
    with pytest.raises(UserError, match=r"judge-60/judge.msgpack: was trained on frames of 60 × 60 pixels"):
        first.judge(tmp_path / "judge-60")


def test_runs_that_differ_in_seeds_alone_are_replicates(tmp_path: Path) -> None:
    config = presets.debug()
    seeds = replace(config, train=replace(config.train, seed=1), sim=replace(config.sim, seed=2), name="other")
    longer = replace(config, train=replace(config.train, steps=config.train.steps + 1))
    runs = {"a": config, "b": longer, "c": seeds, "d": config.with_family("genie")}
    found = replicates({name: run(tmp_path / name, one) for name, one in runs.items()})
    assert found == {"a": "a", "b": "b", "c": "a", "d": "d"}


def test_the_stages_of_a_training_are_of_one_training(tmp_path: Path) -> None:
    assert training_of(tmp_path / "policy" / "at-50") == training_of(tmp_path / "policy") == str(tmp_path / "policy")
    assert training_of(tmp_path / "policy-seed1") != training_of(tmp_path / "policy")
