from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import ConfigError, SampleConfig, presets
from rsjax.config.config_fields import with_values
from rsjax.models.roboscape.departures.guidance import guided as guided_logits
from rsjax.models.roboscape.sample import apply_network, encode_prompt, new_cache, rollout
from rsjax.models.roboscape.transformer import Transformer
from tests.models.roboscape.toy import depart
from tests.models.roboscape.toy_sample import BATCH, DUAL, KEY, given, random_params

GUIDED = depart(DUAL, action_dropout=0.2)


def flat(tokens: dict[str, Any]) -> dict[str, Any]:
    return {name: grid.reshape(*grid.shape[:2], -1) for name, grid in tokens.items()}


def test_guided_logits_lie_on_the_line_through_those_without_and_with_actions() -> None:
    """In two pieces through the cache, against two whole passes without."""
    guidance = 3.0
    params, (tokens, actions) = random_params(GUIDED), given(GUIDED, 4, 4)
    apply, mask = jax.jit(Transformer(GUIDED).apply), np.zeros((BATCH, 4, 3, 3), bool)
    with_, without = (
        apply({"params": params}, tokens, mask, actions, drop_actions=jnp.full(BATCH, drop))[0]
        for drop in (False, True)
    )
    sample = SampleConfig(guidance=guidance)
    guided = jax.jit(partial(apply_network, GUIDED, sample))
    cache: Any = new_cache(GUIDED, sample, BATCH, 6)
    for start in (0, 2):
        here = slice(start, start + 2)
        piece = {name: grid[:, here] for name, grid in flat(tokens).items()}
        hidden = mask[:, here].reshape(BATCH, 2, 9)
        logits, cache, _ = guided(params, piece, hidden, actions[:, here], start, cache)
        for name, x in logits.items():
            expected = without[name] + guidance * (with_[name] - without[name])
            np.testing.assert_allclose(x, expected[:, here], rtol=1e-4, atol=1e-4)


def test_each_clip_has_its_own_strength_of_guidance_where_strengths_are_given() -> None:
    logits = np.random.default_rng(0).normal(size=(4, 2, 9, 2, 8)).astype(np.float32)
    found = guided_logits(SampleConfig(guidance=2.0), {"rgb": jnp.array(logits)}, jnp.array([0.5, 3.0]))["rgb"]
    for clip, strength in enumerate((0.5, 3.0)):
        without = logits[2 + clip]
        np.testing.assert_allclose(found[clip], without + strength * (logits[clip] - without), rtol=1e-5, atol=1e-5)


def test_where_the_null_action_is_the_action_guidance_changes_nothing() -> None:
    params, (tokens, actions) = random_params(GUIDED), given(GUIDED, 1)
    actions[:] = 0.0  # as the first frame's, which has none
    params["null_action"] = params["action_encoder"]["bias"]
    make = lambda guidance: rollout(GUIDED, SampleConfig(guidance=guidance), params, tokens, actions, KEY)  # noqa: E731
    plain = make(1.0)
    jax.tree.map(np.testing.assert_array_equal, make(4.0), plain)
    params["null_action"] = params["null_action"] + 1
    assert not np.array_equal(make(4.0)["rgb"], plain["rgb"])


def test_guidance_of_a_model_that_never_dropped_actions_is_refused() -> None:
    tokens, actions = given(DUAL, 1)
    with pytest.raises(ConfigError, match=r"model.sample.guidance is 2.0 .* model.departures.action_dropout above 0"):
        rollout(DUAL, SampleConfig(guidance=2.0), random_params(DUAL), tokens, actions, KEY)
    debug = presets.debug()
    with pytest.raises(ConfigError, match=r"model.sample.guidance is 2.0"):
        with_values(debug, {"model.sample.guidance": 2.0})
    with pytest.raises(ConfigError, match=r"model.sample.window_stride is 6 of 6 positions"):
        with_values(debug, {"model.sample.window_stride": 6})


def test_a_bfloat16_cache_is_half_as_large_and_nearly_as_good() -> None:
    params, (tokens, actions) = random_params(DUAL), given(DUAL, 5, 5)
    sizes, logits = [], []
    for sample in (SampleConfig(), SampleConfig(cache_dtype="bfloat16")):
        cache = encode_prompt(DUAL, sample, params, tokens, actions).state.cache
        sizes.append(sum(x.nbytes for x in jax.tree.leaves(cache)))
        last = {name: grid[:, -1:] for name, grid in flat(tokens).items()}
        mask = jnp.zeros((BATCH, 1, 9), bool)
        apply = jax.jit(partial(apply_network, DUAL, sample))
        logits.append(apply(params, last, mask, actions[:, -1:], 4, cache)[0]["rgb"])
    assert sizes[0] == 2 * sizes[1]
    spread = np.abs(logits[0]).max()
    assert 0 < np.abs(logits[1] - logits[0]).max() < 0.02 * spread
    roll = partial(rollout, DUAL, SampleConfig(cache_dtype="bfloat16"))
    assert jax.eval_shape(roll, params, tokens, given(DUAL, 5, 8)[1], KEY)["rgb"].shape[1] == 8
