from dataclasses import replace
from pathlib import Path

import pytest

from rsjax.config import Config, presets, to_dict
from rsjax.errors import UserError
from rsjax.files import write_json
from rsjax.policies.run_data import RunData


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
    other = run(tmp_path / "other", config.with_family("irasim"))
    with pytest.raises(UserError, match="other: a model of family 'irasim' cannot generate frame by frame"):
        other.check_world(first)
    small = run(
        tmp_path / "small", replace(config, sim=replace(config.sim, control_steps=config.sim.control_steps + 1))
    )
    with pytest.raises(
        UserError, match=r"small: frames of 64 pixels and actions of \d+ numbers, .*first has 64 and 28"
    ):
        small.check_world(first)
    with pytest.raises(UserError, match="new: its world model is not trained yet"):
        run(tmp_path / "new", config, trained=False).check_world(first)
