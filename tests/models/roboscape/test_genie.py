"""Genie: RoboScape's RGB branch alone, with actions through an MLP that starts without effect."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import Config, CorruptionConfig, GenieConfig, LossConfig, NoDepth, RoboScapeConfig, presets
from rsjax.models.base import create_model
from rsjax.models.genie.model import Genie
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.model import RoboScape
from rsjax.tools.bench import inputs
from rsjax.trainable import Params, StepContext
from tests.models.roboscape.toy import BATCH, RGB, apply, random_inputs, random_params

MLP = replace(RGB, action_encoder="mlp")
ENCODER = {"action_encoder_fc1", "action_encoder_fc2"}
WITHOUT = replace(RGB, action_encoder="none", action_inputs=0)
CONTEXT = StepContext(jnp.int32(0), None, None)


def debug(model: GenieConfig | RoboScapeConfig) -> Config:
    return replace(presets.debug(), model=model)


def logits(network: Architecture, params: Params, actions: Any) -> np.ndarray:
    tokens, mask, _ = random_inputs(MLP)
    return np.asarray(apply(network, params, tokens, mask, actions)[0]["rgb"])


@pytest.fixture(scope="module")
def fresh() -> Params:
    """Random parameters but for the action encoder's last layer, which is as it starts."""
    created = jax.jit(create_model(debug(GenieConfig(width=8, blocks=1, heads=2))).init)(jax.random.key(0))
    assert created["action_encoder_fc1"]["kernel"].any()
    last = created["action_encoder_fc2"]
    assert not (last["kernel"].any() or last["bias"].any())
    params = random_params(MLP)
    return params | {"action_encoder_fc2": jax.tree.map(np.zeros_like, params["action_encoder_fc2"])}


def test_fresh_logits_are_those_of_the_same_parameters_without_actions(fresh: Params) -> None:
    """So a Genie with actions begins as the public Genie whose weights it has."""
    actions = random_inputs(MLP)[2]
    public = {name: x for name, x in fresh.items() if name not in ENCODER}
    expected = logits(WITHOUT, public, None)
    assert expected.std() > 0.1
    np.testing.assert_array_equal(logits(MLP, fresh, actions), expected)
    np.testing.assert_array_equal(logits(MLP, fresh, actions + 1), expected)


def test_actions_count_once_the_last_layer_has_changed(fresh: Params) -> None:
    actions = random_inputs(MLP)[2]
    changed = fresh | {"action_encoder_fc2": random_params(MLP)["action_encoder_fc2"]}
    assert np.abs(logits(MLP, changed, actions + 1) - logits(MLP, changed, actions)).max() > 0.1


def test_training_can_move_the_last_layer_away_from_zero(fresh: Params) -> None:
    tokens, mask, actions = random_inputs(MLP)

    def loss(params: Params) -> Any:
        return jnp.sum(jnp.square(apply(MLP, params, tokens, mask, actions)[0]["rgb"]))

    assert jax.jit(jax.grad(loss))(fresh)["action_encoder_fc2"]["kernel"].any()


def test_its_parameters_and_loss_are_those_of_the_rgb_branch() -> None:
    corruption = CorruptionConfig(probability=1.0)
    small: dict[str, Any] = {"width": 8, "blocks": 1, "heads": 2, "corruption": corruption, "action_encoder": "mlp"}
    genie = create_model(debug(GenieConfig(**small)))
    loss = LossConfig(keypoints="none")
    alone = create_model(debug(RoboScapeConfig(depth=NoDepth(), loss=loss, **small)))
    assert (type(genie), type(alone)) == (Genie, RoboScape)
    assert genie.loss_weights == alone.loss_weights == {"rgb": 1.0}
    shapes, expected = (jax.eval_shape(model.init, jax.random.key(0)) for model in (genie, alone))
    assert jax.tree.map(jnp.shape, shapes) == jax.tree.map(jnp.shape, expected)
    assert shapes.keys() - {"pos_embed", "rgb_embed", "blocks", "rgb_head"} == ENCODER

    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda x: rng.normal(scale=0.3, size=x.shape).astype(np.float32), shapes)
    batch = inputs.batch(genie, presets.debug(), BATCH)
    terms = [
        jax.jit(lambda params, model=model: model.loss_terms(params, batch, jax.random.key(1), CONTEXT))(params)
        for model in (genie, alone)
    ]
    jax.tree.map(np.testing.assert_array_equal, *terms)
    assert terms[0].keys() == {"rgb"}
    assert all(np.all(x > 0) for x in jax.tree.leaves(terms))


def test_every_preset_of_a_family_makes_that_family() -> None:
    for config in presets.PRESETS.values():
        assert type(create_model(config)).__name__.lower() == config.model.family
