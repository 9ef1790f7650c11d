"""Tests that the figures computed from shapes equal those of real arrays."""

import io
import json
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from rich.console import Console

from rsjax.config import Config, presets
from rsjax.config.config_fields import with_values
from rsjax.models.base import create_model
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.objective import Batch
from rsjax.models.roboscape.transformer import empty_cache
from rsjax.tools.commands import describe as command
from rsjax.tools.describe import activation_bytes, count, describe, render
from rsjax.trainable import StepContext
from rsjax.training.state import create_state
from rsjax.training.step import combine

DEBUG = presets.get("debug")
NETWORK = Architecture.create(DEBUG)
described = cache(describe)


def bytes_of(tree: Any) -> int:
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def with_blocks(blocks: int) -> Config:
    return with_values(DEBUG, {"model.blocks": blocks})


def test_every_parameter_belongs_to_one_part() -> None:
    description = described(DEBUG)
    whole = jax.eval_shape(create_model(DEBUG).init, jax.random.key(0))
    parts = description.modules["world_model"]
    assert count(parts) == count(whole) == description.figures["params_world_model"]
    assert list(parts) == ["rgb", "depth", "projections", "shared"]
    assert count(parts["rgb"]) == count(parts["depth"])
    assert parts["projections"] == {"blocks": {"depth_to_rgb": whole["blocks"]["depth_to_rgb"]}}
    assert parts["shared"].keys() == {"pos_embed", "action_encoder"}
    assert description.figures["params_encoder"] + description.figures["params_decoder"] == count(
        description.modules["tokenizer"]
    )


def test_one_branch_is_the_model_without_depth() -> None:
    alone = with_values(DEBUG, {"model.depth": "none"})
    assert described(DEBUG).figures["params_one_branch"] == described(alone).figures["params_world_model"]


def test_a_genie_is_one_branch_with_its_action_encoder() -> None:
    genie = describe(DEBUG.with_family("genie"))
    assert list(genie.modules["world_model"]) == ["rgb", "shared"]
    assert genie.modules["world_model"]["shared"].keys() == {"pos_embed", "action_encoder_fc1", "action_encoder_fc2"}
    assert genie.figures["params_one_branch"] == genie.figures["params_world_model"]


def test_the_state_in_training_has_the_bytes_of_a_whole_one_and_of_its_gradients() -> None:
    config = replace(DEBUG, train=replace(DEBUG.train, ema=0.9))
    state = jax.eval_shape(lambda: create_state(create_model(config), config.loop("world_model")))
    whole = bytes_of((state.params, state.opt_state, state.ema)) + bytes_of(state.params)
    assert describe(config).figures["bytes_train_state"] == whole


def test_the_cache_has_the_bytes_of_a_real_one() -> None:
    kept = described(DEBUG).figures["bytes_cache_float32"]
    assert kept == bytes_of(empty_cache(NETWORK, 1, NETWORK.frames))


def kept_for(clips: int) -> int:
    """Returns the bytes that the loss's backward pass holds for a batch of ``clips`` clips."""
    model, frames = create_model(DEBUG), DEBUG.clips.frames
    tokens = jnp.zeros((clips, frames, DEBUG.grid, DEBUG.grid), jnp.int32)
    tracks = (clips, DEBUG.clips.tracks, frames)
    batch = Batch(
        rgb=tokens,
        depth=tokens,
        actions=jnp.zeros((clips, frames, DEBUG.clips.action_dim)),
        tracks=jnp.zeros((*tracks, 2)),
        visible=jnp.ones(tracks, bool),
        weight=jnp.ones(clips),
        index=jnp.arange(clips, dtype=jnp.int32),
    )

    def loss(params: Any, key: jax.Array) -> Any:
        terms = model.loss_terms(params, batch, key, StepContext(jnp.int32(0), None, None))
        return combine(terms, model.loss_weights)[0]

    def backward(key: jax.Array) -> Any:
        return jax.vjp(lambda params: loss(params, key), model.init(key))[1]

    return bytes_of(jax.eval_shape(backward, jax.random.key(0)))


def test_activations_are_what_another_clip_adds_to_what_the_backward_pass_holds() -> None:
    assert activation_bytes(DEBUG)[False] == kept_for(3) - kept_for(2)


def test_with_remat_another_block_adds_its_inputs_and_depth_s_output_alone() -> None:
    one, two, three = (activation_bytes(with_blocks(n)) for n in (1, 2, 3))
    of_features = 3 * NETWORK.frames * NETWORK.grid**2 * NETWORK.width * 4
    assert three[True] - two[True] == two[True] - one[True] == of_features
    assert three[False] - two[False] == two[False] - one[False] > 10 * of_features


def test_the_terminal_shows_every_module_and_figure() -> None:
    description = described(DEBUG)
    console = Console(width=140, record=True, file=io.StringIO())
    console.print(render(description))
    text = console.export_text()
    for word in ("projections", "depth_to_rgb", "qkv", "(2, 32, 96)", "up_1_upsample"):
        assert word in text
    for name, value in description.figures.items():
        assert f"{name.replace('_', ' ')} " in text
        assert f"{value:,}" in text


def test_the_command_prints_figures_as_json_with_overrides_applied(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["describe", "debug", "--json", "--model.depth", "none"])
    command.main()
    printed = json.loads(capsys.readouterr().out)
    assert printed == {"preset": "debug"} | described(with_values(DEBUG, {"model.depth": "none"})).figures
