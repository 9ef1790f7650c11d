from dataclasses import replace
from functools import partial
from math import prod
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.sharding import PartitionSpec as P

from rsjax.config import AdamW, ConfigError, LoopConfig, Muon, presets
from rsjax.models.roboscape.model import RoboScape
from rsjax.tokenizers.training import TokenizerTraining
from rsjax.trainable import Trainable
from rsjax.training.sharding import (
    FSDP,
    SMALL,
    PartitionedArray,
    Sharding,
    cut_elements,
    partitioned_arrays,
    shown,
    spec_of,
)
from rsjax.training.state import create_state


def rows(model: Trainable[Any], loop: LoopConfig, parts: int) -> dict[str, PartitionedArray]:
    shapes = jax.eval_shape(partial(create_state, model, loop))
    found = partitioned_arrays(shapes, parts)
    print(shown(found))
    return {row.path: row for row in found}


def world_model(preset: str, kind: Any = "adamw", parts: int = 8) -> dict[str, PartitionedArray]:
    config = presets.get(preset)
    loop = replace(config.loop("world_model"), ema=0.99, optimizer={"muon": Muon, "adamw": AdamW}[kind]())
    return rows(RoboScape.create(config), loop, parts)


def test_the_full_size_model_is_cut_as_the_rules_say() -> None:
    found = world_model("roboscape_s")
    assert {path: found[f"params/{path}"].spec for path in WANTED} == WANTED


WANTED = {
    "action_encoder/kernel": P(),  # 28 × 256: small
    "blocks/depth_to_rgb/kernel": P(None, None, FSDP),
    "blocks/rgb/fc1/bias": P(None, FSDP),
    "blocks/rgb/fc1/kernel": P(None, None, FSDP),
    "blocks/rgb/fc2/kernel": P(None, None, FSDP),
    "blocks/rgb/norm1/scale": P(),
    "blocks/rgb/spatial_attn/qkv/kernel": P(None, None, FSDP),
    "blocks/depth/temporal_attn/proj/kernel": P(None, None, FSDP),
    "pos_embed": P(None, None, FSDP),
    "rgb_embed/factored_embed_0/embedding": P(None, FSDP),
    "rgb_embed/mask_token_embed": P(),
    "rgb_head/kernel": P(None, FSDP),
}


@pytest.mark.parametrize("preset", ["roboscape_s", "roboscape_tiny"])
@pytest.mark.parametrize("kind", ["adamw", "muon"])
def test_moments_and_averages_lie_as_their_parameter(preset: str, kind: str) -> None:
    found = world_model(preset, kind)
    params = {path.removeprefix("params/"): row for path, row in found.items() if path.startswith("params/")}
    followers = 0
    for path, row in found.items():
        for name, parameter in params.items():
            if path.endswith(f"/{name}") and path.startswith(("ema/", "opt_state/")):
                assert (row.shape, row.spec) == (parameter.shape, parameter.spec), path
                followers += 1
    moments = sum(2 - (kind == "muon" and "blocks/" in name and name.endswith("kernel")) for name in params)
    assert followers == len(params) + moments, "an average, and two moments each, of which Muon keeps one of a matrix"


@pytest.mark.parametrize("preset", ["roboscape_s", "roboscape_tiny"])
def test_nearly_all_of_a_state_is_cut(preset: str) -> None:
    found = list(world_model(preset).values())
    assert cut_elements(found) / sum(prod(row.shape) for row in found) > 0.97


def test_the_full_size_tokenizer_is_cut_but_for_what_is_small_or_has_no_axis_that_divides() -> None:
    config = presets.get("roboscape_s")
    loop = config.loop("tokenizer")
    found = rows(TokenizerTraining.create(config), loop, 8)
    whole = {row.path.removeprefix("params/") for row in found.values() if row.spec == P() and prod(row.shape) >= SMALL}
    assert not whole


@given(
    path=st.sampled_from(["params/blocks/a/kernel", "params/blocks/b", "params/head/kernel", "params/new", "extra/x"]),
    shape=st.lists(st.sampled_from([1, 3, 8, 12, 64, 250]), max_size=4).map(tuple),
    parts=st.sampled_from([1, 2, 3, 8]),
)
def test_what_is_cut_is_large_and_divides(path: str, shape: tuple[int, ...], parts: int) -> None:
    spec = spec_of(path, shape, parts)
    if spec != P():
        assert spec == P(*[None] * (len(spec) - 1), FSDP)
        assert shape[len(spec) - 1] % parts == 0
        assert prod(shape) >= SMALL
        assert not path.startswith("extra")
    elif path == "params/new" and parts > 1 and prod(shape) >= SMALL:
        assert all(size % parts for size in shape), "an array that no rule names is cut along any axis that divides"


def test_the_table_names_what_is_cut() -> None:
    text = shown(partitioned_arrays({"params": {"head": {"kernel": np.zeros((256, 64))}, "bias": np.zeros(64)}}, 8))
    assert "params/head/kernel" in text
    assert "(256, [64])" in text
    assert text.endswith("16,448 elements, 99.6% of them cut")


def test_a_model_whose_arrays_fsdp_does_not_divide_is_refused() -> None:
    config = presets.get("tiny")
    loop = LoopConfig(batch_size=5, sharding="mesh", fsdp=5)
    mesh: Any = jax.sharding.AbstractMesh((1, 5), ("data", FSDP))  # five devices that nothing is put on
    sharding = Sharding("mesh", mesh)
    with pytest.raises(ConfigError, match="fsdp 5 divides no axis of this model's arrays"):
        sharding.template(RoboScape.create(config), loop)
