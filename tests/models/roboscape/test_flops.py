"""Operations by formula are those of the traced program."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from rsjax.config import Departures, PublicCodeConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.departures.motion_head import MotionHead
from rsjax.models.roboscape.flops import forward_flops, motion_head_flops
from rsjax.models.roboscape.transformer import Transformer
from rsjax.tokenizers.flops import products
from tests.models.roboscape.toy import roboscape

NARROW = PublicCodeConfig(mlp_ratio=2)
DUAL = Architecture(frames=5, grid=3, code_bits=8, action_inputs=3, width=32, blocks=3, heads=2)


def world_model(config: Architecture) -> tuple[Any, Any, Any]:
    params = jax.eval_shape(Transformer(config).init_params, jax.random.key(0))
    grid = jax.ShapeDtypeStruct((1, config.frames, config.grid, config.grid), jnp.int32)
    actions = jax.ShapeDtypeStruct((1, config.frames, config.action_inputs), jnp.float32)

    def logits(params: Any, tokens: Any, actions: Any) -> Any:
        mask = tokens["rgb"] == 0
        return Transformer(config).apply({"params": params}, tokens, mask, actions)[0]

    return logits, params, (dict.fromkeys(config.modalities, grid), actions)


def xla_flops(function: Any, *inputs: Any) -> float:
    analysis: Any = jax.jit(function).lower(*inputs).compile().cost_analysis()
    return analysis["flops"]


@pytest.mark.parametrize(
    "config",
    [
        DUAL,
        replace(DUAL, depth="head", reads_depth=False, second_view=True),
        replace(DUAL, depth_width=16, action_encoder="mlp"),
        replace(DUAL, grid=4, depth_width=16, depth_cells=2, departures=Departures(read_previous=True)),
        replace(DUAL, depth="none", action_encoder="mlp", action_inputs=0),
        replace(DUAL, public_code=NARROW, vocabularies=1),
        replace(DUAL, depth_blocks=1, action_encoder="norms"),
        replace(DUAL, depth="head", action_encoder="norms", departures=Departures(more_norms=True)),
    ],
    ids=["dual", "unread head", "narrow", "coarse", "no actions", "other shapes", "shallow adaptive", "adaptive head"],
)
def test_a_pass_of_the_world_model_is_the_formula_to_the_letter(config: Architecture) -> None:
    logits, params, inputs = world_model(config)
    assert products(jax.make_jaxpr(logits)(params, *inputs).jaxpr) == forward_flops(config, config.frames)


def test_a_motion_head_costs_its_formula_in_training_alone() -> None:
    config = replace(DUAL, motion_head=True)
    params = jax.eval_shape(Transformer(config).init_params, jax.random.key(0))["motion_head"]
    features = jax.ShapeDtypeStruct((1, config.frames, config.grid**2, config.width), jnp.float32)
    head = jax.make_jaxpr(lambda params, x: MotionHead().apply({"params": params}, x))(params, features)
    cost = motion_head_flops(config, config.frames)
    assert products(head.jaxpr) == cost > motion_head_flops(DUAL, DUAL.frames) == 0
    plain = roboscape(DUAL).flops(config.frames)
    assert roboscape(config).flops(config.frames) == {**plain, "train": plain["train"] + 3 * cost}


def test_xla_counts_little_more_for_a_block_of_usual_width() -> None:
    # One block: XLA counts what is inside a scan once. The rest is norms, softmaxes, GELUs and one-hot reads.
    config = Architecture(frames=4, grid=4, width=128, blocks=1, heads=4)
    logits, params, inputs = world_model(config)
    counted = xla_flops(logits, params, *inputs)
    assert 1 <= counted / forward_flops(config, config.frames) < 1.05

    def loss(params: Any, *inputs: Any) -> Any:
        return sum(jnp.sum(jnp.square(x)) for x in logits(params, *inputs).values())

    counted = xla_flops(jax.grad(loss), params, *inputs)
    assert counted == pytest.approx(3 * forward_flops(config, config.frames), rel=0.05)
