import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from rsjax.config import ConfigError, LoopConfig
from rsjax.train.placement import Placement

ROOT = Path(__file__).parents[2]


def test_every_placement_gives_the_same_parameters_on_uneven_batches() -> None:
    """The devices have to exist before jax starts, hence a process of its own; unoptimised, as it mostly compiles."""
    flags = "--xla_force_host_platform_device_count=4 --xla_backend_optimization_level=0"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-m", "tests.train.devices"], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    apart = json.loads(done.stdout.splitlines()[-1])
    for placement in ("pmap", "mesh"):
        assert apart[placement]["largest"] < 1e-5, apart
        assert apart[placement]["share"] < 1e-5, apart
    assert apart["mean of ratios"]["share"] > 0.1, "the batches are too even to tell the right loss from the wrong one"
    assert apart["tokenizer"].keys() == {"generator", "discriminator", "averages"}
    assert max(apart["tokenizer"].values()) < 1e-5, apart
    assert min(apart["tokenizer apart"].values()) > 0.1, "the images are too even to tell the placements apart"


@pytest.mark.parametrize(
    ("placement", "local", "batch_size", "devices"),
    [
        ("jit", 4, 8, 0),
        ("pmap", 4, 8, 4),
        ("pmap", 1, 8, 1),
        ("auto", 4, 8, 4),
        ("auto", 4, 6, 3),
        ("auto", 4, 5, 0),
        ("auto", 1, 8, 0),
    ],
)
def test_auto_takes_as_many_devices_as_divide_the_batch(
    placement: Any, local: int, batch_size: int, devices: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jax, "local_device_count", lambda: local)
    assert Placement.create(LoopConfig(batch_size=batch_size, placement=placement)).devices == devices


def test_a_batch_that_does_not_divide_over_all_devices_is_refused_where_all_are_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(jax, "local_device_count", lambda: 4)
    with pytest.raises(ConfigError, match="batch_size 6 does not divide over 4 devices; make it a multiple"):
        Placement.create(LoopConfig(batch_size=6, placement="pmap"))


def test_each_device_takes_its_own_consecutive_clips() -> None:
    batch = {"x": np.arange(12).reshape(6, 2), "weight": np.ones(6)}
    cut = Placement(3).put_batch(batch)
    np.testing.assert_array_equal(cut["x"], batch["x"].reshape(3, 2, 2))
    assert cut["weight"].shape == (3, 2)
