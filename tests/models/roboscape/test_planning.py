"""One prompt under many action sequences."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from rsjax.config import SampleConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.sample import encode_prompt, rollout, rollout_from
from tests.models.roboscape.toy import depart
from tests.models.roboscape.toy_sample import KEY, NO_PARAMS, RGB, SMALL, count_model, given, random_params

CANDIDATES, PROMPT, FRAMES = 3, 3, 8
GUIDED = depart(RGB, rotary=True, action_dropout=0.1)
STRONG = SampleConfig(temperature=1.0, guidance=2.0)


@pytest.mark.parametrize(
    ("model", "sample"),
    [(SMALL, SampleConfig(temperature=1.0)), (GUIDED, STRONG)],
    ids=["small-branch", "rotary-guided"],
)
def test_sharing_a_prompt_is_repeating_it(model: Architecture, sample: SampleConfig) -> None:
    params, (tokens, actions) = random_params(model), given(model, PROMPT, FRAMES, CANDIDATES)
    one = {name: grid[:1] for name, grid in tokens.items()}
    actions[:, :PROMPT] = actions[:1, :PROMPT]
    repeated = {name: grid.repeat(CANDIDATES, 0) for name, grid in one.items()}
    expected = rollout(model, sample, params, repeated, actions, KEY)
    prompt = encode_prompt(model, sample, params, one, actions[:1, :PROMPT])
    shared = rollout_from(model, sample, params, prompt, actions[:, PROMPT:], KEY)
    jax.tree.map(np.testing.assert_array_equal, shared, expected)


def test_candidates_of_equal_numbers_differ_by_their_actions_alone() -> None:
    params, (tokens, actions) = random_params(GUIDED), given(GUIDED, PROMPT, FRAMES, 1)
    prompt = encode_prompt(GUIDED, STRONG, params, tokens, actions[:, :PROMPT])
    plans = actions[:, PROMPT:].repeat(CANDIDATES, 0)
    plans[2] += 1
    out = rollout_from(GUIDED, STRONG, params, prompt, plans, KEY, index=np.zeros(CANDIDATES, np.int32))["rgb"]
    np.testing.assert_array_equal(out[0], out[1])
    assert not np.array_equal(out[0], out[2])
    apart = rollout_from(GUIDED, STRONG, params, prompt, plans, KEY)["rgb"]
    assert not np.array_equal(apart[0], apart[1])


def test_a_shared_prompt_is_run_once(monkeypatch: pytest.MonkeyPatch) -> None:
    model, sample, seen = replace(RGB, grid=1, frames=FRAMES), SampleConfig(steps=2), count_model(monkeypatch)
    tokens = {"rgb": np.zeros((1, PROMPT, 1, 1), np.int32)}
    with jax.disable_jit():
        prompt = encode_prompt(model, sample, NO_PARAMS, tokens, np.zeros((1, PROMPT, 3), np.float32))
        assert seen.pop("frames") == PROMPT - 1
        plans = np.zeros((CANDIDATES, FRAMES - PROMPT, 3), np.float32)
        rollout_from(model, sample, NO_PARAMS, prompt, plans, KEY)
    assert seen["frames"] == CANDIDATES * (FRAMES - PROMPT) * 3


def test_a_prompt_that_does_not_fit_the_rollout_is_refused() -> None:
    params, (tokens, actions) = random_params(GUIDED), given(GUIDED, 1, 2, 2)
    prompt = jax.eval_shape(lambda: encode_prompt(GUIDED, STRONG, params, tokens, actions[:, :1]))
    for rows, sample, message in (
        ((2, 1), SampleConfig(), "the prompt was encoded with guided = True"),
        ((2, 1), replace(STRONG, window_stride=2), "the prompt was encoded with window_stride = 3"),
        ((2, 1), replace(STRONG, cache_dtype="bfloat16"), "the prompt was encoded with cache_dtype = 'float32'"),
        ((3, 2), STRONG, "a prompt of 2 clips and 3 action sequences"),
        ((2, 0), STRONG, "1 frames with a prompt of 1"),
    ):
        with pytest.raises(ValueError, match=message):
            rollout_from(GUIDED, sample, params, prompt, np.zeros((*rows, 3)), KEY)


def test_what_does_not_touch_the_prompts_cache_may_change_after_it() -> None:
    params, (tokens, actions) = random_params(GUIDED), given(GUIDED, PROMPT, FRAMES, 1)
    alike = SampleConfig(guidance=0.5, steps=4, window_stride=3)  # a stride of 0 is half the window: 3
    prompts = [encode_prompt(GUIDED, each, params, tokens, actions[:, :PROMPT]) for each in (STRONG, alike)]
    assert prompts[0].settings == prompts[1].settings
    jax.tree.map(np.testing.assert_array_equal, *prompts)
