"""The roofline's operations are those of the model."""

from dataclasses import replace

import pytest

from rsjax.bench.roofline import operations, roofline
from rsjax.bench.run import bench
from rsjax.config import ConfigError, presets
from rsjax.models.base import create_model
from rsjax.models.roboscape.flops import forward_flops
from tests.models.toy_family import ToyConfig


@pytest.mark.parametrize("name", ["tiny", "genie_35m", "roboscape_s"])
def test_their_products_are_all_that_the_model_counts(name: str) -> None:
    config = presets.get(name)
    arch = replace(create_model(config).architecture, action_inputs=0)  # type: ignore[attr-defined]
    counted = sum(each.times * each.flops for each in operations(arch, config, 3))
    assert counted == 3 * forward_flops(arch, config.clips.frames)


def test_other_families_and_a_missing_ceiling() -> None:
    config = presets.debug()
    assert roofline(replace(config, model=ToyConfig()), 1, 1e9, 0.0) == {}
    with pytest.raises(ConfigError, match="--only matmul,roofline"):
        bench(config, only=["roofline"])
