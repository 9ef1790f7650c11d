import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from jax.sharding import Mesh

from rsjax.config import ConfigError, LoopConfig
from rsjax.training.sharding import AXIS, Sharding, choose
from rsjax.training.step import train_step
from tests.training.toy import Regression

ROOT = Path(__file__).parents[2]


def virtual(devices: int) -> dict[str, str]:
    """The environment of a process with so many devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    return os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}


@pytest.fixture(scope="module")
def apart() -> dict[str, Any]:
    """Results of tests/training/four_devices.py. The devices must exist before jax starts, hence its own process."""
    command = [sys.executable, "-m", "tests.training.four_devices"]
    done = subprocess.run(command, cwd=ROOT, env=virtual(4), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_every_familys_step_is_the_same_under_pmap_and_accumulated_on_a_mesh(apart: dict[str, Any]) -> None:
    """Genie's is RoboScape's."""
    assert apart["families"].keys() == {"IVideoGPT", "KLTraining", "IRASim", "CogVideoX"}
    assert all(distance < 1e-5 for distance in apart["families"].values()), apart


def test_every_sharding_gives_the_same_parameters_on_uneven_batches(apart: dict[str, Any]) -> None:
    for kind in ("pmap", "mesh", "fsdp", "muon"):
        assert apart[kind]["largest"] < 1e-4, apart
        assert apart[kind]["share"] < 1e-4, apart


def test_clips_without_depth_count_alike_on_every_device_and_in_every_part(apart: dict[str, Any]) -> None:
    for kind in ("gradient pmap", "gradient fsdp", "gradient heads"):
        assert apart[kind] < 1e-5, apart
    assert apart["metrics pmap"] < 2e-5 and apart["metrics fsdp"] < 2e-5, apart


def test_the_tokenizers_gradients_and_averages_are_those_of_the_whole_batch(apart: dict[str, Any]) -> None:
    for kind in ("pmap", "fsdp"):
        assert apart[f"tokenizer {kind}"].keys() == {"generator", "discriminator", "averages"}
        assert all(distance < 1e-5 for distance in apart[f"tokenizer {kind}"].values()), apart


def test_a_checkpoint_resumes_under_any_other_sharding(apart: dict[str, Any]) -> None:
    assert len(apart["checkpoint"]) == 3
    for distance in apart["checkpoint"]:
        assert distance["share"] < 1e-4, apart


def test_a_state_that_is_made_in_parts_is_the_same_to_the_bit_and_each_device_holds_about_half(
    apart: dict[str, Any],
) -> None:
    assert apart["start"]
    assert 0.5 < apart["cut"] < 0.6


def test_devices_divide_the_clips_of_a_batch_that_is_generated_or_scored(apart: dict[str, Any]) -> None:
    assert {name.removeprefix("rsjax.models."): rows for name, rows in apart["in rows"].items()} == {
        "ivideogpt.rollout.sample": [True],
        "ivideogpt.autoencoder._apply": [True] * 2,
        "roboscape.teacher_forcing._score_window": [True] * 2,
    }


def test_a_training_with_the_same_settings_compiles_nothing_again() -> None:
    loop = LoopConfig(batch_size=8, sharding="jit")
    first = Sharding.create(loop).compile(train_step, Regression(), loop)
    assert Sharding.create(loop).compile(train_step, Regression(), loop) is first
    other = LoopConfig(batch_size=8, sharding="jit", steps=loop.steps + 1)
    assert Sharding.create(other).compile(train_step, Regression(), other) is not first


@pytest.mark.parametrize(
    ("fields", "local", "processes", "chosen"),
    [
        ({"sharding": "jit"}, 4, 1, ("jit", 1)),
        ({"sharding": "pmap"}, 2, 4, ("pmap", 8)),
        ({"sharding": "mesh", "fsdp": 2}, 4, 2, ("mesh", 8)),
        ({}, 4, 1, ("pmap", 4)),
        ({"batch_size": 6}, 4, 1, ("pmap", 3)),
        ({"batch_size": 5}, 4, 1, ("jit", 1)),
        ({}, 1, 1, ("jit", 1)),
        ({"accumulate": 4}, 4, 1, ("pmap", 2)),
        ({}, 4, 2, ("mesh", 8)),
    ],
)
def test_auto_takes_as_many_devices_as_divide_the_batch(
    fields: dict[str, Any], local: int, processes: int, chosen: tuple[str, int]
) -> None:
    assert choose(LoopConfig(**({"batch_size": 8} | fields)), local, processes) == chosen


@pytest.mark.parametrize(
    ("fields", "local", "processes", "message"),
    [
        ({"sharding": "pmap"}, 4, 1, "over 4 devices; make it a multiple, or set sharding to auto"),
        ({}, 2, 2, "batch_size 6 does not divide over 4 devices; make it a multiple$"),
        ({"sharding": "mesh", "accumulate": 2}, 2, 1, "over 2 devices in accumulate = 2 parts"),
        ({"sharding": "mesh", "fsdp": 2}, 3, 1, "fsdp 2 does not divide 3 devices"),
        ({"sharding": "jit"}, 1, 2, "sharding is jit, for one device, but 2 processes train"),
    ],
)
def test_what_does_not_divide_is_refused(fields: dict[str, Any], local: int, processes: int, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        choose(LoopConfig(**({"batch_size": 6} | fields)), local, processes)


def test_each_device_takes_its_own_consecutive_clips() -> None:
    sharding = Sharding("pmap", Mesh(np.array(jax.devices()[:1]), (AXIS,)))
    batch = {"x": np.arange(12).reshape(6, 2), "weight": np.ones(6)}
    cut = sharding.put_batch(batch)
    np.testing.assert_array_equal(cut["x"], batch["x"].reshape(1, 6, 2))
    assert cut["weight"].shape == (1, 6)


def test_a_gathered_copy_outlives_the_step_that_takes_its_state() -> None:
    loop = LoopConfig(batch_size=2, ema=0.5, sharding="jit")
    sharding = Sharding.create(loop)
    state = sharding.init(Regression(), loop)
    copy = sharding.gather(state.weights)
    before = jax.device_get(copy)
    batch = sharding.put_batch({"x": np.ones((2, 3), np.float32), "y": np.zeros(2, np.float32)})
    state, _ = sharding.compile(train_step, Regression(), loop)(state, batch)
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(copy), before)
