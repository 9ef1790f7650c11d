from dataclasses import replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import PublicCodeConfig
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Transformer, empty_cache
from tests.models.roboscape.toy import (
    ADAPTIVE,
    BATCH,
    COARSE,
    DUAL,
    GENIE,
    GUIDED,
    HEAD,
    NORMED,
    QK_NORM,
    READS_PREVIOUS,
    SMALL,
    WHOLE,
    apply,
    apply_plain,
    blind,
    depart,
    forward,
    plain_forward,
    random_inputs,
    random_params,
)

CONFIGS = {
    "dual": DUAL,
    "qk-norm": QK_NORM,
    "genie": GENIE,
    "previous-normed": depart(READS_PREVIOUS, more_norms=True),
    "whole-frames-head": replace(WHOLE, depth="head"),
    "head-unread-previous": depart(replace(HEAD, reads_depth=False), read_previous=True),
    "coarse": COARSE,
    "small": SMALL,
    "adaptive": ADAPTIVE,
    "adaptive-small": replace(SMALL, action_encoder="norms"),
}
PIECED = replace(SMALL, departures=DUAL.departures, public_code=PublicCodeConfig(qk_norm=True))


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_logits_are_those_of_the_plain_computation(config: Architecture) -> None:
    params, inputs = random_params(config), random_inputs(config)
    logits, expected = forward(config, params, inputs), plain_forward(config, params, inputs)
    assert logits.keys() == expected.keys()
    for name in logits:
        np.testing.assert_allclose(logits[name], expected[name], rtol=1e-3, atol=1e-3, err_msg=name)


def count(params: Any) -> int:
    return sum(x.size for x in jax.tree.leaves(params))


@pytest.mark.parametrize(("width", "published"), [(256, 35_218_688), (512, 137_545_216)])
def test_one_branch_without_actions_has_the_published_size(width: int, published: int) -> None:
    config = Architecture(width=width, depth="none", action_inputs=0)
    params = jax.eval_shape(Transformer(config).init_params, jax.random.key(0))
    assert count(params) == published

    dual = jax.eval_shape(Transformer(replace(config, depth="branch")).init_params, jax.random.key(0))
    assert count(dual) == 2 * published - count(params["pos_embed"]) + config.blocks * (width + 1) * width


def test_without_an_action_encoder_actions_are_not_read() -> None:
    params, (tokens, mask, actions) = random_params(GENIE), random_inputs(GENIE)
    assert actions.shape[-1] == 0
    expected = forward(GENIE, params, (tokens, mask, actions))["rgb"]
    for other in (None, random_inputs(DUAL)[2]):
        np.testing.assert_array_equal(forward(GENIE, params, (tokens, mask, other))["rgb"], expected)


def test_a_dropped_clip_sees_the_null_action_in_every_frame_and_the_others_their_own() -> None:
    params, (tokens, mask, actions) = random_params(GUIDED), random_inputs(GUIDED)
    drop = np.array([True, False])
    dropped, _ = apply(GUIDED, params, tokens, mask, actions, 0, None, drop)
    own = forward(GUIDED, params, (tokens, mask, actions))
    null = dict(params, action_encoder={"kernel": np.zeros((3, 8), np.float32), "bias": params["null_action"]})
    without = forward(GUIDED, null, (tokens, mask, actions))
    for name in own:
        np.testing.assert_allclose(dropped[name][0], without[name][0], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(dropped[name][1], own[name][1], rtol=1e-4, atol=1e-4)
        assert not np.allclose(own[name][0], without[name][0], atol=0.1)


def test_a_clip_without_depth_has_it_hidden_in_every_frame_and_the_others_as_the_mask_says() -> None:
    params, (tokens, mask, actions) = random_params(DUAL), random_inputs(DUAL)
    hidden, _ = apply(DUAL, params, tokens, mask, actions, no_depth=np.array([True, False]))
    own = forward(DUAL, params, (tokens, mask, actions))
    without = forward(DUAL, blind(params), (tokens, mask, actions))
    for name in own:
        np.testing.assert_allclose(hidden[name][0], without[name][0], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(hidden[name][1], own[name][1], rtol=1e-4, atol=1e-4)
        assert not np.allclose(own[name][0], without[name][0], atol=0.1)
    other = tokens | {"depth": tokens["depth"] ^ np.array([5, 0])[:, None, None, None]}
    again, _ = apply(DUAL, params, other, mask, actions, no_depth=np.array([True, False]))
    jax.tree.map(np.testing.assert_array_equal, hidden, again)


def test_hiding_depth_leaves_the_callers_mask_as_it_is() -> None:
    inputs = random_inputs(DUAL)
    before = inputs[1].copy()
    jax.eval_shape(
        lambda params: apply_plain(DUAL, params, *inputs, no_depth=np.ones(BATCH, bool)), random_params(DUAL)
    )
    np.testing.assert_array_equal(inputs[1], before)


def test_adaptive_norms_begin_as_the_network_without_actions() -> None:
    params, (tokens, mask, actions) = jax.jit(Transformer(ADAPTIVE).init_params)(jax.random.key(0)), random_inputs(DUAL)
    plain = {"blocks": jax.tree.map(np.asarray, params["blocks"])}
    for branch in ADAPTIVE.branches:
        del plain["blocks"][branch]["action_norms"]
    without = replace(NORMED, action_encoder="none", action_inputs=0)
    expected = forward(without, params | plain, (tokens, mask, None))
    for name, logits in forward(ADAPTIVE, params, (tokens, mask, actions)).items():
        np.testing.assert_allclose(logits, expected[name], rtol=1e-5, atol=1e-6)


def test_actions_cannot_be_dropped_without_a_null_action() -> None:
    with pytest.raises(ValueError, match="model.departures.action_dropout"):
        apply_plain(DUAL, random_params(DUAL), *random_inputs(DUAL), drop_actions=np.array([True, False]))


def test_remat_changes_neither_parameters_nor_gradients() -> None:
    params, inputs = random_params(DUAL), random_inputs(DUAL)

    def gradients(config: Architecture) -> Any:
        loss = lambda params: sum(jnp.mean(jnp.square(x)) for x in apply_plain(config, params, *inputs)[0].values())  # noqa: E731
        return jax.jit(jax.grad(loss))(params)

    plain = gradients(DUAL)
    for again in (gradients(replace(DUAL, remat="products")), gradients(replace(DUAL, remat="blocks"))):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), plain, again)


def test_of_the_remat_policies_each_keeps_less_than_the_one_before() -> None:
    params, inputs = random_params(DUAL), random_inputs(DUAL)

    def kept(remat: Literal["none", "products", "blocks"]) -> int:
        forward = lambda params: apply_plain(replace(DUAL, remat=remat), params, *inputs)[0]  # noqa: E731
        return sum(x.size for x in jax.tree.leaves(jax.eval_shape(lambda p: jax.vjp(forward, p)[1], params)))

    assert kept("none") > kept("products") > kept("blocks")


def test_a_future_frame_never_changes_a_past_logit() -> None:
    params, (tokens, mask, actions) = random_params(DUAL), random_inputs(DUAL)
    other_tokens, other_mask, other_actions = random_inputs(DUAL, seed=1)
    before = forward(DUAL, params, (tokens, mask, actions))
    for t in range(1, DUAL.frames):
        past = lambda x, y, t=t: np.concatenate([x[:, :t], y[:, t:]], axis=1)  # noqa: E731
        changed = (jax.tree.map(past, tokens, other_tokens), past(mask, other_mask), past(actions, other_actions))
        after = forward(DUAL, params, changed)
        for name in before:
            np.testing.assert_array_equal(before[name][:, :t], after[name][:, :t])
            assert not np.allclose(before[name][:, t:], after[name][:, t:])


def test_frames_that_do_not_begin_a_clip_need_the_frame_before_them() -> None:
    with pytest.raises(ValueError, match="pass previous"):
        apply_plain(READS_PREVIOUS, random_params(READS_PREVIOUS), *random_inputs(READS_PREVIOUS), start=1)


@pytest.fixture(scope="module")
def fresh() -> Any:
    return jax.jit(Transformer(DUAL).init_params)(jax.random.key(0))


def test_a_fresh_model_begins_with_the_projection_at_zero(fresh: Any) -> None:
    assert not any(np.any(x) for x in jax.tree.leaves(fresh["blocks"]["depth_to_rgb"]))
    kernels = fresh["blocks"]["rgb"]["fc1"]["kernel"]
    assert not np.allclose(kernels[0], kernels[1])  # blocks are drawn apart


def test_pieces_through_the_cache_are_the_whole() -> None:
    params, (tokens, mask, actions) = random_params(PIECED), random_inputs(PIECED)
    whole = forward(PIECED, params, (tokens, mask, actions))
    cache, start = empty_cache(PIECED, BATCH, PIECED.frames), 0
    for length in (1, 2, 1, 1):
        here = slice(start, start + length)
        piece = ({name: x[:, here] for name, x in tokens.items()}, mask[:, here], actions[:, here])
        logits, cache = apply(PIECED, params, *piece, start, cache)
        for name in whole:
            np.testing.assert_allclose(logits[name], whole[name][:, here], rtol=1e-4, atol=1e-4)
        start += length


@pytest.mark.usefixtures("bf16_units")
def test_bfloat16_computes_nearly_the_same_and_gives_float32(fresh: Any) -> None:
    inputs = random_inputs(DUAL)
    exact, rough = forward(DUAL, fresh, inputs), forward(replace(DUAL, compute_dtype="bfloat16"), fresh, inputs)
    for name in exact:
        assert rough[name].dtype == jnp.float32
        assert 0 < np.abs(rough[name] - exact[name]).max() < 0.1
