from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import SampleConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.sample import rollout
from rsjax.models.roboscape.transformer import TokenEmbed, Transformer
from rsjax.tokenizers import lfq
from tests.models.roboscape.toy import depart
from tests.models.roboscape.toy_sample import (
    BATCH,
    DUAL,
    HEAD,
    KEY,
    NO_PARAMS,
    RGB,
    SMALL,
    count_model,
    given,
    random_params,
)

WHOLE = depart(DUAL, read_previous=True, whole_frames=True)
ADAPTIVE = replace(depart(SMALL, more_norms=True), action_encoder="norms")
WARM = SampleConfig(steps=2, temperature=1.0)


@pytest.mark.parametrize(
    ("model", "prompt", "sample"),
    [
        (WHOLE, 3, WARM),
        (depart(HEAD, read_previous=True), 3, SampleConfig(steps=4, unmask="greedy")),
        (ADAPTIVE, 1, SampleConfig(steps=2)),
    ],
    ids=["whole-warm", "head-greedy", "adaptive-small"],
)
def test_cached_is_uncached(model: Architecture, prompt: int, sample: SampleConfig) -> None:
    params, (tokens, actions) = random_params(model), given(model, prompt)
    cached, plain = (rollout(model, sample, params, tokens, actions, KEY, cached=c) for c in (True, False))
    assert cached.keys() == tokens.keys()
    for name, grid in cached.items():
        np.testing.assert_array_equal(grid, plain[name], err_msg=name)
        np.testing.assert_array_equal(grid[:, :prompt], tokens[name])
        assert grid.shape == (BATCH, 6, 3, 3)
        assert np.ptp(grid[:, prompt:]) > 0


def test_a_single_greedy_step_is_the_models_most_probable_frame() -> None:
    """One decoding step from the definition: mask frame t, keep the frames before, take the argmax."""
    model, params, (tokens, actions) = DUAL, random_params(DUAL), given(DUAL, 1)
    out = rollout(model, SampleConfig(steps=1), params, tokens, actions, KEY)
    apply = jax.jit(Transformer(model).apply)
    for t in range(1, 6):
        mask = np.zeros((BATCH, 6, 3, 3), bool)  # a new one: jax may still be reading the one before
        mask[:, t:] = True
        logits, _ = apply({"params": params}, out, mask, actions)
        for name in out:
            codes = np.asarray(logits[name][:, t]).argmax(-1)
            np.testing.assert_array_equal(out[name][:, t].reshape(BATCH, -1), codes[..., 0] + 8 * codes[..., 1])


@pytest.mark.parametrize("read", [False, True])
def test_a_frames_mean_codes_follow_from_what_it_reads(read: bool) -> None:
    """In one step: tokens as without mean codes, or mean codes."""
    model = depart(DUAL, read_previous=True)
    params, (tokens, actions) = random_params(model), given(model, 2)
    sample = SampleConfig(steps=1, mean_codes=True, read_means=read)
    made = rollout(model, sample, params, tokens, actions, KEY)
    seen = made
    if not read:
        seen = rollout(model, replace(sample, mean_codes=False), params, tokens, actions, KEY)
    apply = jax.jit(Transformer(model).apply)
    for name, means in made.items():
        assert means.shape == (BATCH, 6, 3, 3, model.code_bits)
        np.testing.assert_array_equal(means[:, :2], lfq.tokens_to_codes(jnp.asarray(tokens[name]), model.code_bits))
        for t in range(2, 6):
            mask = np.zeros((BATCH, 6, 3, 3), bool)
            mask[:, t:] = True
            logits, _ = apply({"params": params}, seen, mask, actions)
            expected = lfq.mean_codes(logits[name][:, t], model.code_bits).reshape(means[:, t].shape)
            np.testing.assert_allclose(means[:, t], expected, atol=1e-5)


def test_what_is_drawn_is_shown_as_tokens() -> None:
    tokens, actions = given(RGB, 1)
    warm = partial(rollout, RGB, replace(WARM, mean_codes=True, read_means=True))
    assert jax.eval_shape(warm, random_params(RGB), tokens, actions, KEY)["rgb"].dtype == jnp.int32


def test_the_key_decides_the_draws_and_actions_the_video() -> None:
    params, (tokens, actions) = random_params(RGB), given(RGB, 3)
    make = lambda actions, key: np.asarray(rollout(RGB, WARM, params, tokens, actions, key)["rgb"])  # noqa: E731
    first = make(actions, KEY)
    np.testing.assert_array_equal(first, make(actions, KEY))
    assert not np.array_equal(first, make(actions, jax.random.key(6)))

    later = actions.copy()
    later[:, 5:] += 3
    np.testing.assert_array_equal(first[:, :5], make(later, KEY)[:, :5])
    assert not np.array_equal(first, make(later, KEY))


def test_a_rollout_without_a_frame_to_make_is_refused() -> None:
    tokens, actions = given(RGB, 3, 3)
    with pytest.raises(ValueError, match="3 frames with a prompt of 3"):
        rollout(RGB, SampleConfig(), random_params(RGB), tokens, actions, KEY)
    with pytest.raises(ValueError, match="2 prompts and 3 action sequences; encode_prompt"):
        rollout(RGB, SampleConfig(), random_params(RGB), tokens, np.zeros((3, 6, 3)), KEY)


def test_a_clips_draws_follow_its_number_and_not_its_place() -> None:
    params, (tokens, actions) = random_params(RGB), given(RGB, 3)
    both = rollout(RGB, WARM, params, tokens, actions, KEY, index=np.array([4, 7]))["rgb"]
    turned = rollout(RGB, WARM, params, {"rgb": tokens["rgb"][::-1]}, actions[::-1], KEY, index=np.array([7, 4]))
    np.testing.assert_array_equal(both[::-1], turned["rgb"])
    alone = rollout(RGB, WARM, params, {"rgb": tokens["rgb"][1:]}, actions[1:], KEY, index=np.array([7]))["rgb"]
    np.testing.assert_array_equal(both[1:], alone)
    other = rollout(RGB, WARM, params, tokens, actions, KEY, index=np.array([4, 8]))["rgb"]
    np.testing.assert_array_equal(both[0], other[0])
    assert not np.array_equal(both[1], other[1])


@pytest.mark.parametrize(("steps", "cached_passes"), [(1, 30), (2, 45)])
def test_a_rollout_costs_the_frame_passes_that_it_should(
    steps: int, cached_passes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pass over f frames counts f."""
    model, seen = replace(RGB, frames=16, grid=1), count_model(monkeypatch)
    tokens, costs = {"rgb": np.zeros((1, 1, 1, 1), np.int32)}, []
    with jax.disable_jit():
        for cached in (True, False):
            seen.clear()
            rollout(model, SampleConfig(steps=steps), NO_PARAMS, tokens, np.zeros((1, 16, 3)), KEY, cached=cached)
            costs.append(seen["frames"])
    assert costs == [cached_passes, steps * 15 * 16]


def test_a_whole_frame_costs_one_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    model = depart(replace(RGB, frames=16, grid=1), read_previous=True, whole_frames=True)
    seen = count_model(monkeypatch)
    tokens = {"rgb": np.zeros((1, 3, 1, 1), np.int32)}
    with jax.disable_jit():
        rollout(model, SampleConfig(steps=1), NO_PARAMS, tokens, np.zeros((1, 16, 3)), KEY)
    assert seen["frames"] == 16  # the prompt, in one pass, and 13 others


def test_codes_of_tokens_are_read_as_the_tokens_and_mean_codes_as_the_mean() -> None:
    model = depart(DUAL, read_previous=True)
    params, (tokens, actions) = random_params(model), given(model, 6)
    mask = np.random.default_rng(3).random((BATCH, 6, 3, 3)) < 0.5
    apply = jax.jit(Transformer(model).apply)
    codes = {name: lfq.tokens_to_codes(jnp.asarray(grid), model.code_bits) for name, grid in tokens.items()}
    of_tokens, of_codes = (apply({"params": params}, cells, mask, actions)[0] for cells in (tokens, codes))
    jax.tree.map(partial(np.testing.assert_allclose, atol=1e-5), of_codes, of_tokens)

    embed: Any = partial(TokenEmbed(model).apply, {"params": params["rgb_embed"]})
    either = jnp.array([[[5]], [[13]]])  # they differ in bit 3 alone
    unsure = lfq.tokens_to_codes(either, model.code_bits).mean(0, keepdims=True)
    visible = jnp.zeros((2, 1, 1), bool)
    expected = embed(either, visible).mean(0, keepdims=True)
    np.testing.assert_allclose(embed(unsure, visible[:1]), expected, atol=1e-6)
