"""Rollouts of clips without depth, alone and among clips with it."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import SampleConfig
from rsjax.models.roboscape import sample as module
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.sample import encode_prompt, rollout, rollout_from
from tests.models.roboscape.toy import blind, depart
from tests.models.roboscape.toy_sample import DUAL, HEAD, KEY, RGB, given, random_params

CLIPS = 3
SOME = np.array([False, True, False])
ALL = np.ones(CLIPS, bool)
WARM = SampleConfig(steps=2, temperature=1.0, window_stride=2)
GUIDED = depart(DUAL, action_dropout=0.2, rotary=True, read_previous=True)
# Few, and shared by all tests here: compiling is most of the work.
WINDOW = (DUAL, WARM, 2, 12)
ONE_TRUNK = (HEAD, WARM, 2, 12)
ROTARY = (GUIDED, replace(WARM, guidance=2.0, unmask="greedy"), 8, 11)


def same(one: Any, other: Any, rows: Any = slice(None)) -> None:
    assert one.keys() == other.keys()
    for name in one:
        np.testing.assert_array_equal(one[name][rows], other[name][rows], err_msg=name)


@pytest.mark.parametrize(
    ("model", "sample", "prompt", "frames"), [WINDOW, ROTARY], ids=["window", "guided-rotary-greedy"]
)
def test_cached_is_uncached_and_a_clip_is_as_it_is_among_its_like(
    model: Architecture, sample: SampleConfig, prompt: int, frames: int
) -> None:
    params, (tokens, actions) = random_params(model), given(model, prompt, frames, CLIPS)

    def make(no_depth: Any, cached: bool = True) -> Any:
        return rollout(model, sample, params, tokens, actions, KEY, cached, no_depth=no_depth)

    mixed = make(SOME)
    same(mixed, make(SOME, cached=False))
    same(mixed, make(None), ~SOME)
    same(mixed, make(ALL), SOME)
    assert not mixed["depth"][SOME].any()
    assert np.ptp(np.asarray(mixed["depth"])[~SOME, prompt:]) > 0
    assert not np.array_equal(mixed["rgb"][SOME], make(None)["rgb"][SOME]), "depth is of no use to this model"


@pytest.mark.parametrize("way", [WINDOW, ONE_TRUNK], ids=["branch", "head"])
def test_a_clip_without_depth_is_that_of_a_model_which_is_blind_to_depth_tokens(way: Any) -> None:
    model, sample, prompt, frames = way
    params, (tokens, actions) = random_params(model), given(model, prompt, frames, CLIPS)
    hidden = rollout(model, sample, params, tokens, actions, KEY, no_depth=SOME)["rgb"]
    unseen = rollout(model, sample, blind(params), tokens, actions, KEY)["rgb"]
    np.testing.assert_array_equal(hidden[SOME], unseen[SOME])
    assert not np.array_equal(hidden[~SOME], unseen[~SOME])


@pytest.mark.parametrize("way", [ONE_TRUNK, ROTARY], ids=["head", "guided-rotary-greedy"])
def test_depth_tokens_of_clips_without_depth_are_not_read_and_need_not_be_given(way: Any) -> None:
    model, sample, prompt, frames = way
    params, (tokens, actions) = random_params(model), given(model, prompt, frames, CLIPS)
    make = lambda tokens, no_depth: rollout(model, sample, params, tokens, actions, KEY, no_depth=no_depth)  # noqa: E731
    other = tokens | {"depth": np.where(SOME[:, None, None, None], tokens["depth"] ^ 9, tokens["depth"])}
    same(make(other, SOME), make(tokens, SOME))
    without = make({"rgb": tokens["rgb"]}, None)
    same(without, make(tokens, ALL))
    same(without, make({"rgb": tokens["rgb"]}, ALL))
    assert not without["depth"].any()


def test_from_an_encoded_prompt_is_a_rollout() -> None:
    model, sample, prompt, frames = WINDOW
    params, (tokens, actions) = random_params(model), given(model, prompt, frames, CLIPS)
    encoded = encode_prompt(model, sample, params, tokens, actions[:, :prompt], SOME)
    resumed = rollout_from(model, sample, params, encoded, actions[:, prompt:], KEY)
    same(resumed, rollout(model, sample, params, tokens, actions, KEY, no_depth=SOME))


def test_one_prompt_without_depth_is_shared_like_any_other() -> None:
    model, sample, prompt, frames = ROTARY
    params, (tokens, actions) = random_params(model), given(model, prompt, frames, CLIPS)
    actions[:, :prompt] = actions[:1, :prompt]
    one = {"rgb": tokens["rgb"][:1]}
    encoded = encode_prompt(model, sample, params, one, actions[:1, :prompt])
    shared = rollout_from(model, sample, params, encoded, actions[:, prompt:], KEY)
    same(shared, rollout(model, sample, params, {"rgb": one["rgb"].repeat(CLIPS, 0)}, actions, KEY))


def test_where_all_clips_have_depth_it_is_as_if_nothing_was_said() -> None:
    model, sample, prompt, frames = WINDOW
    params, (tokens, actions) = random_params(model), given(model, prompt, frames, CLIPS)
    make = lambda no_depth: rollout(model, sample, params, tokens, actions, KEY, no_depth=no_depth)  # noqa: E731
    compiled: Any = module._rollout
    plain, programs = make(None), compiled._cache_size()
    same(make(~ALL), plain)
    assert compiled._cache_size() == programs
    same(make(jnp.asarray(~ALL)), plain)


def test_a_model_without_depth_does_not_ask() -> None:
    params, (tokens, actions) = random_params(RGB), given(RGB, 2, 6, CLIPS)
    encoded = jax.eval_shape(lambda: encode_prompt(RGB, WARM, params, tokens, actions[:, :2], SOME))
    assert encoded.state.no_depth is None


def test_what_does_not_fit_the_prompt_is_refused() -> None:
    params, (tokens, actions) = random_params(DUAL), given(DUAL, 2, 6, CLIPS)
    for make in (
        lambda tokens, no_depth: rollout(DUAL, WARM, params, tokens, actions, KEY, no_depth=no_depth),
        lambda tokens, no_depth: encode_prompt(DUAL, WARM, params, tokens, actions[:, :2], no_depth),
    ):
        with pytest.raises(ValueError, match=r"no_depth has shape \(2,\); the prompt has 3 clips"):
            make(tokens, SOME[:2])
        with pytest.raises(ValueError, match='the prompt has no tokens "depth"'):
            make({"rgb": tokens["rgb"]}, SOME)
