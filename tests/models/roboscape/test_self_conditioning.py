"""Training on the model's own frames, against two passes written out."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import RoboScapeConfig
from rsjax.models.roboscape.departures.self_conditioning import conditions_itself, previous_frames
from rsjax.models.roboscape.model import RoboScape
from rsjax.models.roboscape.transformer import Transformer
from rsjax.tokenizers import lfq
from rsjax.trainable import StepContext
from rsjax.training.step import combine
from rsjax.training.validation import validation_loss
from tests.models.roboscape.test_loss_terms import KEY, LOSS, random_batch
from tests.models.roboscape.test_loss_terms import MODEL as VISIBLE
from tests.models.roboscape.toy import depart, random_params, roboscape

MODEL = depart(VISIBLE, read_previous=True, whole_frames=True)


def model_of(own: float, after: int = 0) -> RoboScape:
    departures = replace(MODEL.departures, self_conditioning=own, self_conditioning_after=after)
    return roboscape(MODEL, RoboScapeConfig(departures=departures, loss=LOSS, corruption=None))


LATE = model_of(1.0, after=5)


@partial(jax.jit, static_argnums=0)
def gradient(model: RoboScape, params: Any, batch: Any, step: Any) -> Any:
    def loss(params: Any) -> Any:
        return combine(model.loss_terms(params, batch, KEY, StepContext(step, None, None)), model.loss_weights)

    return jax.value_and_grad(loss, has_aux=True)(params)


def test_a_step_on_own_frames_reads_the_mean_codes_of_a_pass_on_true_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    params, batch = random_params(MODEL), random_batch()
    tokens = {name: jnp.asarray(getattr(batch, name)) for name in MODEL.branches}
    mask, apply = jnp.zeros(batch.rgb.shape, bool), jax.jit(Transformer(MODEL).apply)
    first, _ = apply({"params": params}, tokens, mask, batch.actions)
    own: dict[str, np.ndarray] = {}
    for name, logits in first.items():
        means = np.array(lfq.mean_codes(logits, MODEL.code_bits))
        true = np.asarray(lfq.tokens_to_codes(tokens[name], MODEL.code_bits)).reshape(means.shape)
        own[name] = np.concatenate([true[:, :1], true[:, :1], means[:, 1:-1]], axis=1)
    second, _ = apply({"params": params}, tokens, mask, batch.actions, previous=own)
    expected = 0.0
    for clip, t, row, column in np.ndindex(*batch.rgb.shape):
        if t and batch.weight[clip]:
            log_p = jax.nn.log_softmax(second["rgb"][clip, t, 2 * row + column])
            token = int(tokens["rgb"][clip, t, row, column])
            expected -= float(sum(log_p[k, (token // 4**k) % 4] for k in range(2)))
    here = gradient(LATE, params, batch, jnp.int32(5))
    np.testing.assert_allclose(here[0][1]["rgb"], expected / (batch.weight.sum() * 3 * 4), rtol=1e-4)

    # The gradient is that of the second pass, with what it reads held fixed.
    def fixed(predict: Any, tokens: Any, code_bits: int, own_step: Any, prompt_frames: int) -> Any:
        assert prompt_frames == 1
        return {name: jnp.asarray(codes) for name, codes in own.items()}

    monkeypatch.setattr("rsjax.models.roboscape.model.previous_frames", fixed)
    there = gradient(model_of(0.5), params, batch, jnp.int32(0))
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5), here, there)


@pytest.mark.parametrize("prompt", [1, 3])
def test_the_prompts_frames_stay_true(prompt: int) -> None:
    tokens = {"rgb": jnp.full((1, 5, 1, 1), 15)}  # all bits 1
    zeros = {"rgb": jnp.zeros((1, 5, 1, 2, 4))}  # so that all mean codes are 0
    read = previous_frames(lambda: (zeros, None), tokens, 4, True, prompt)["rgb"]
    true = [1.0] * (prompt + 1)  # frame 0 reads itself
    np.testing.assert_array_equal(read[0, :, 0, 0], (true + [0.0] * 5)[:5])


def test_before_its_first_own_frames_a_step_is_the_one_on_true_frames() -> None:
    params, batch = random_params(MODEL), random_batch()
    true = gradient(model_of(0.0), params, batch, jnp.int32(4))
    early, late = (gradient(LATE, params, batch, jnp.int32(step)) for step in (4, 5))
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-3, atol=1e-5), early, true)
    assert abs(late[0][0] - true[0][0]) > 1e-3


def test_validation_reads_true_frames_also_of_a_model_that_trains_on_its_own_from_the_first_step_on() -> None:
    params, batch = random_params(MODEL), random_batch()
    off, on = (validation_loss(model, params, [batch]) for model in (model_of(0.0), model_of(1.0)))
    assert on == pytest.approx(off, rel=1e-5)


def test_a_share_of_the_steps_reads_own_frames() -> None:
    departures = replace(MODEL.departures, self_conditioning=0.3, self_conditioning_after=100)
    keys = jax.vmap(partial(jax.random.fold_in, KEY))(jnp.arange(1100))
    drawn = np.asarray(jax.vmap(partial(conditions_itself, departures))(keys, jnp.arange(1100)))
    assert not drawn[:100].any()
    assert 0.25 < drawn[100:].mean() < 0.35
