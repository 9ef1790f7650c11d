"""A loss weight of 0 switches its term off: it is neither in the loss nor in the log."""

from typing import Any

import jax
import jax.numpy as jnp
import pytest

from rsjax.config import presets
from rsjax.config.config_fields import with_values
from rsjax.models.base import create_model
from rsjax.tools.bench import inputs
from rsjax.trainable import StepContext
from rsjax.training.step import combine

DEBUG = presets.debug()


@pytest.mark.parametrize("off", [[], ["depth"], ["keypoint"], ["attention"], ["keypoint", "attention"]], ids=str)
def test_what_has_a_weight_of_0_is_no_term(off: list[str]) -> None:
    model = create_model(with_values(DEBUG, {f"model.loss.{name}_weight": 0.0 for name in off}))

    def loss(params: Any, batch: Any, key: Any) -> Any:
        terms = model.loss_terms(params, batch, key, StepContext(jnp.int32(0), None, None))
        return combine(terms, model.loss_weights)[1]

    params = jax.eval_shape(model.init, jax.random.key(0))
    logged = jax.eval_shape(loss, params, inputs.batch_shapes(model, DEBUG), jax.random.key(0))
    assert logged.keys() == {"rgb", "depth", "keypoint", "attention"} - set(off)
