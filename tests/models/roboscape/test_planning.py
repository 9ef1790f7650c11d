"""One prompt under many action sequences."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from rsjax.config import SampleConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.sample import encode_prompt, rollout, rollout_from
from tests.models.roboscape.toy import depart
from tests.models.roboscape.toy_sample import DUAL, KEY, NO_PARAMS, RGB, SMALL, count_model, given, random_params

CANDIDATES, PROMPT, FRAMES = 3, 3, 8


@pytest.mark.parametrize(
    ("model", "sample"),
    [
        (DUAL, SampleConfig(temperature=1.0)),
        (SMALL, SampleConfig(temperature=1.0)),
        (depart(RGB, rotary=True, action_dropout=0.1), SampleConfig(temperature=1.0, guidance=2.0)),
    ],
    ids=["dual", "small-branch", "rotary-guided"],
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
    sample, params, (tokens, actions) = SampleConfig(temperature=1.0), random_params(RGB), given(RGB, 2, FRAMES, 1)
    prompt = encode_prompt(RGB, sample, params, tokens, actions[:, :2])
    plans = actions[:, 2:].repeat(3, 0)
    plans[2] += 1
    out = rollout_from(RGB, sample, params, prompt, plans, KEY, index=np.zeros(3, np.int32))["rgb"]
    np.testing.assert_array_equal(out[0], out[1])
    assert not np.array_equal(out[0], out[2])
    apart = rollout_from(RGB, sample, params, prompt, plans, KEY)["rgb"]
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


@pytest.mark.parametrize(
    ("field", "plain", "other"),
    [
        ("guided", SampleConfig(), SampleConfig(guidance=2.0)),
        ("window_stride", SampleConfig(), SampleConfig(window_stride=2)),
        ("cache_dtype", SampleConfig(), SampleConfig(cache_dtype="bfloat16")),
    ],
)
def test_a_prompt_encoded_for_other_sampling_is_refused(field: str, plain: SampleConfig, other: SampleConfig) -> None:
    model = depart(RGB, action_dropout=0.1)
    params, (tokens, actions) = random_params(model), given(model, 2, 4, 1)
    for before, after in ((plain, other), (other, plain)):
        prompt = jax.eval_shape(lambda s=before: encode_prompt(model, s, params, tokens, actions[:, :2]))
        with pytest.raises(ValueError, match=f"the prompt was encoded with {field} = "):
            rollout_from(model, after, params, prompt, actions[:, 2:], KEY)


def test_what_does_not_touch_the_prompts_cache_may_change_after_it() -> None:
    model = depart(RGB, action_dropout=0.1)
    params, (tokens, actions) = random_params(model), given(model, 2, FRAMES, 1)
    sample, alike = SampleConfig(guidance=2.0, temperature=1.0), SampleConfig(guidance=0.5, steps=4, window_stride=3)
    made = []
    for encoded in (sample, alike):  # a stride of 0 is half the window: 3
        prompt = encode_prompt(model, encoded, params, tokens, actions[:, :2])
        made.append(rollout_from(model, sample, params, prompt, actions[:, 2:], KEY)["rgb"])
    np.testing.assert_array_equal(made[0], made[1])


def test_a_prompt_of_neither_one_clip_nor_as_many_is_refused() -> None:
    params, (tokens, actions) = random_params(RGB), given(RGB, 1, 2, 2)
    prompt = encode_prompt(RGB, SampleConfig(), params, tokens, actions[:, :1])
    with pytest.raises(ValueError, match="a prompt of 2 clips and 3 action sequences"):
        rollout_from(RGB, SampleConfig(), params, prompt, np.zeros((3, 2, 3)), KEY)
    with pytest.raises(ValueError, match="1 frames with a prompt of 1"):
        rollout_from(RGB, SampleConfig(), params, prompt, np.zeros((2, 0, 3)), KEY)
