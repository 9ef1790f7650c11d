"""The roofline's operations are those of the model."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from rsjax.config import ConfigError, SmallDepthBranch, TokenizerConfig, presets
from rsjax.config.config_fields import with_values
from rsjax.layers.cpu import convolution
from rsjax.models.base import create_model
from rsjax.models.roboscape.flops import forward_flops
from rsjax.models.roboscape.model import RoboScape
from rsjax.tokenizers.flops import products, tokenizer_flops
from rsjax.tools.bench.roofline import cached_pass, full_cache, operations, pass_flops, roofline, tokenizer_operations
from rsjax.tools.bench.run import bench
from tests.models.toy_family import ToyConfig


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("roboscape_tiny", {}),
        ("roboscape_tiny", {"model.depth": "head"}),
        ("roboscape_tiny", {"model.depth": SmallDepthBranch(width=64, blocks=2, cells=2)}),
        ("genie_35m", {}),
        ("roboscape_s", {}),
    ],
)
def test_their_products_are_all_that_the_model_counts(name: str, changes: dict[str, Any]) -> None:
    config = with_values(presets.get(name), changes)
    arch = replace(create_model(config).architecture, action_inputs=0)  # type: ignore[attr-defined]
    counted = sum(each.times * each.flops for each in operations(arch, config, 3))
    assert counted == 3 * forward_flops(arch, config.clips.frames)


@pytest.mark.usefixtures("bf16_units")
@pytest.mark.parametrize(
    "changes",
    [{"adaptive_norm": True}, {"patch_size": 2, "local_codes": True, "compute_dtype": "bfloat16"}],
)
def test_the_tokenizers_products_are_all_that_it_counts(
    changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TokenizerConfig(
        channels=8, channel_multipliers=(1, 1, 2), res_blocks=2, norm_groups=4, code_bits=6, **changes
    )
    monkeypatch.setattr(convolution, "LEAST", 8)
    monkeypatch.setattr(convolution, "WIDE", 8)  # one product for all rows of a kernel also multiplies the padding
    halves, counted = tokenizer_operations(config, 64), tokenizer_flops(config, 64)
    for half, name in (("encode", "encoder"), ("decode", "decoder")):
        assert sum(each.times * each.flops for each in halves[half]) == counted[name]
        for each in halves[half]:
            program = jax.make_jaxpr(each.run)(*map(jnp.zeros, each.shapes))
            assert products(program.jaxpr) == each.flops
            wide = each.name.startswith("3x3_") and "stride" not in each.name and min(each.shapes[1][2:]) >= 8
            assert ("scan" in str(program)) == (wide and config.compute_dtype == "bfloat16")


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"depth": "head"},
        {"depth": SmallDepthBranch(width=16, blocks=1)},
        {"depth": "none", "departures.rotary": True},
    ],
)
def test_a_cached_passs_products_are_all_that_the_model_counts(changes: dict[str, Any]) -> None:
    config = with_values(presets.debug(), {f"model.{name}": value for name, value in changes.items()})
    model = create_model(config)
    assert isinstance(model, RoboScape)
    params, cache = jax.eval_shape(model.init, jax.random.key(0)), full_cache(model, 3)
    assert products(jax.make_jaxpr(cached_pass(model, 3))(params, cache).jaxpr) == pass_flops(model.architecture, cache)


def test_other_families_and_a_missing_ceiling() -> None:
    config = presets.debug()
    assert roofline(replace(config, model=ToyConfig()), 1, 1e9, 0.0) == {}
    with pytest.raises(ConfigError, match="--only matmul,roofline"):
        bench(config, only=["roofline"])
