from dataclasses import replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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
    NARROW,
    NORMED,
    QK_NORM,
    READS_PREVIOUS,
    RGB,
    SHALLOW,
    SMALL,
    UNREAD,
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

CONFIGS = {"dual": DUAL, "rgb": RGB, "normed": NORMED, "qk-norm": QK_NORM, "previous": READS_PREVIOUS, "genie": GENIE}
CONFIGS |= {"whole-frames": WHOLE, "head": HEAD, "head-previous": replace(READS_PREVIOUS, depth="head")}
SMALLER = {"narrow": NARROW, "shallow": SHALLOW, "coarse": COARSE, "small": SMALL}
CONFIGS |= SMALLER | {"head-unread": UNREAD, "head-unread-previous": depart(UNREAD, read_previous=True)}
CONFIGS |= {"adaptive": ADAPTIVE, "adaptive-head": replace(HEAD, action_encoder="norms")}
CONFIGS |= {
    "adaptive-rgb": replace(RGB, action_encoder="norms"),
    "adaptive-small": replace(SMALL, action_encoder="norms"),
}
PIECED = {"dual": DUAL, "qk-norm": QK_NORM, "head": HEAD, "small": replace(SMALL, departures=DUAL.departures)}
PIECED |= {"adaptive": ADAPTIVE}


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


def test_qk_norm_trades_two_norms_of_the_width_for_two_of_a_head() -> None:
    block = jax.eval_shape(Transformer(QK_NORM).init_params, jax.random.key(0))["blocks"]["rgb"]
    assert not {"norm1", "norm2"} & block.keys()
    for attention in ("spatial_attn", "temporal_attn"):
        assert block[attention]["norm"]["scale"].shape == (QK_NORM.blocks, QK_NORM.width // QK_NORM.heads)


def test_without_an_action_encoder_actions_are_not_read() -> None:
    params, (tokens, mask, actions) = random_params(GENIE), random_inputs(GENIE)
    assert actions.shape[-1] == 0
    expected = forward(GENIE, params, (tokens, mask, actions))["rgb"]
    for other in (None, random_inputs(DUAL)[2]):
        np.testing.assert_array_equal(forward(GENIE, params, (tokens, mask, other))["rgb"], expected)


@pytest.mark.parametrize("way", ["linear", "norms"])
def test_a_dropped_clip_sees_the_null_action_in_every_frame_and_the_others_their_own(way: Any) -> None:
    guided = replace(GUIDED, action_encoder=way)
    params, (tokens, mask, actions) = random_params(guided), random_inputs(guided)
    drop = np.array([True, False])
    dropped, _ = apply(guided, params, tokens, mask, actions, 0, None, drop)
    own = forward(guided, params, (tokens, mask, actions))
    null = dict(params, action_encoder={"kernel": np.zeros((3, 8), np.float32), "bias": params["null_action"]})
    without = forward(guided, null, (tokens, mask, actions))
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


def test_hiding_depth_leaves_the_callers_mask_and_a_model_without_depth_as_they_are() -> None:
    inputs = random_inputs(DUAL)
    before = inputs[1].copy()
    apply_plain(DUAL, random_params(DUAL), *inputs, no_depth=np.ones(BATCH, bool))
    np.testing.assert_array_equal(inputs[1], before)
    params, inputs = random_params(RGB), random_inputs(RGB)
    alone, _ = apply(RGB, params, *inputs, no_depth=np.ones(BATCH, bool))
    np.testing.assert_array_equal(alone["rgb"], forward(RGB, params, inputs)["rgb"])


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


@pytest.mark.parametrize("remat", ["products", "blocks"])
def test_remat_changes_neither_parameters_nor_gradients(remat: Literal["products", "blocks"]) -> None:
    params, inputs = random_params(DUAL), random_inputs(DUAL)

    def gradients(config: Architecture) -> Any:
        loss = lambda params: sum(jnp.mean(jnp.square(x)) for x in apply_plain(config, params, *inputs)[0].values())  # noqa: E731
        return jax.jit(jax.grad(loss))(params)

    plain, again = gradients(DUAL), gradients(replace(DUAL, remat=remat))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), plain, again)


def test_of_the_remat_policies_each_keeps_less_than_the_one_before() -> None:
    params, inputs = random_params(DUAL), random_inputs(DUAL)

    def kept(remat: Literal["none", "products", "blocks"]) -> int:
        forward = lambda params: apply_plain(replace(DUAL, remat=remat), params, *inputs)[0]  # noqa: E731
        return sum(x.size for x in jax.tree.leaves(jax.eval_shape(lambda p: jax.vjp(forward, p)[1], params)))

    assert kept("none") > kept("products") > kept("blocks")


def test_without_depth_nothing_of_it_exists() -> None:
    params = jax.eval_shape(Transformer(RGB).init_params, jax.random.key(0))
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(params)]
    assert not [path for path in paths if "depth" in path]
    assert empty_cache(RGB, 1, 2).keys() == {"rgb"}


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


def test_masked_tokens_are_read_in_the_next_frame_alone_and_only_where_the_model_reads_the_previous_frame() -> None:
    for config, reads in ((READS_PREVIOUS, True), (DUAL, False)):
        params, (tokens, mask, actions) = random_params(config), random_inputs(config)
        mask[:, 2] = True
        other = {name: x.copy() for name, x in tokens.items()}
        for x in other.values():
            x[:, 2] ^= 5
        before, after = (forward(config, params, (x, mask, actions)) for x in (tokens, other))
        for name in before:
            np.testing.assert_array_equal(before[name][:, :3], after[name][:, :3])
            assert np.any(before[name][:, 3:] != after[name][:, 3:]) == reads


def test_frames_that_do_not_begin_a_clip_need_the_frame_before_them() -> None:
    with pytest.raises(ValueError, match="pass previous"):
        apply_plain(READS_PREVIOUS, random_params(READS_PREVIOUS), *random_inputs(READS_PREVIOUS), start=1)


def test_every_cell_reads_every_cell_of_its_own_and_earlier_frames() -> None:
    params, (tokens, mask, actions) = random_params(DUAL), random_inputs(DUAL)
    shown = (tokens, np.zeros_like(mask), actions)
    before = forward(DUAL, params, shown)
    for cell in range(DUAL.grid**2):
        other = {name: x.copy() for name, x in tokens.items()}
        for x in other.values():
            x.reshape(*x.shape[:2], -1)[:, 2, cell] ^= 5  # a bit of each vocabulary
        after = forward(DUAL, params, (other, *shown[1:]))
        for name in before:
            change = np.abs(after[name] - before[name]).max(axis=(0, 3, 4))  # T S
            assert np.all(change[:2] == 0)
            assert np.all(change[2:] > 1e-6)


@pytest.mark.parametrize("config", [DUAL, ADAPTIVE], ids=["added", "adaptive"])
def test_an_action_reaches_the_frame_that_it_led_into(config: Architecture) -> None:
    params, (tokens, mask, actions) = random_params(config), random_inputs(config)
    other = actions.copy()
    other[:, 3] += 1
    change = {
        name: np.abs(x - forward(config, params, (tokens, mask, other))[name]).max(axis=(0, 2, 3, 4))
        for name, x in forward(config, params, (tokens, mask, actions)).items()
    }
    for x in change.values():
        np.testing.assert_array_equal(x > 0, [False, False, False, True, True])


def test_a_masked_cells_token_is_not_read() -> None:
    params, (tokens, mask, actions) = random_params(DUAL), random_inputs(DUAL)
    others, _, _ = random_inputs(DUAL, seed=1)
    hidden = {name: np.where(mask, others[name], x) for name, x in tokens.items()}
    before, after = (forward(DUAL, params, (x, mask, actions)) for x in (tokens, hidden))
    jax.tree.map(np.testing.assert_array_equal, before, after)


def without_depth(params: Any) -> Any:
    kept = {name: x for name, x in params.items() if not name.startswith("depth")}
    return kept | {"blocks": {"rgb": params["blocks"]["rgb"]}}


def test_with_the_projection_at_zero_the_rgb_branch_is_as_if_alone() -> None:
    params, (tokens, mask, actions) = random_params(DUAL), random_inputs(DUAL)
    joined = forward(DUAL, params, (tokens, mask, actions))["rgb"]
    params["blocks"]["depth_to_rgb"] = jax.tree.map(np.zeros_like, params["blocks"]["depth_to_rgb"])
    zeroed = forward(DUAL, params, (tokens, mask, actions))["rgb"]
    alone = forward(RGB, without_depth(params), ({"rgb": tokens["rgb"]}, mask, actions))["rgb"]
    np.testing.assert_allclose(zeroed, alone, rtol=1e-4, atol=1e-5)
    assert not np.allclose(joined, alone, atol=0.1)


def test_a_fresh_model_begins_with_the_projection_at_zero() -> None:
    params = jax.jit(Transformer(DUAL).init_params)(jax.random.key(0))
    assert not any(np.any(x) for x in jax.tree.leaves(params["blocks"]["depth_to_rgb"]))
    kernels = params["blocks"]["rgb"]["fc1"]["kernel"]
    assert not np.allclose(kernels[0], kernels[1])  # blocks are drawn apart


def test_depth_never_reads_rgb() -> None:
    params, (tokens, mask, actions) = random_params(DUAL), random_inputs(DUAL)
    others, _, _ = random_inputs(DUAL, seed=1)
    before, after = (forward(DUAL, params, (x, mask, actions)) for x in (tokens, tokens | {"rgb": others["rgb"]}))
    np.testing.assert_array_equal(before["depth"], after["depth"])
    assert not np.allclose(before["rgb"], after["rgb"])


@pytest.mark.parametrize(
    "config",
    [DUAL, QK_NORM, HEAD, replace(SMALL, departures=DUAL.departures)],
    ids=["dual", "qk-norm", "head", "small"],
)
@pytest.mark.parametrize("pieces", [(1, 1, 1, 1, 1), (2, 3)], ids=str)
def test_pieces_through_the_cache_are_the_whole(config: Architecture, pieces: tuple[int, ...]) -> None:
    params, (tokens, mask, actions) = random_params(config), random_inputs(config)
    whole = forward(config, params, (tokens, mask, actions))
    cache, start = empty_cache(config, BATCH, config.frames), 0
    for length in pieces:
        here = slice(start, start + length)
        piece = ({name: x[:, here] for name, x in tokens.items()}, mask[:, here], actions[:, here])
        logits, cache = apply(config, params, *piece, start, cache)
        for name in whole:
            np.testing.assert_allclose(logits[name], whole[name][:, here], rtol=1e-4, atol=1e-4)
        start += length


def test_what_a_cache_held_of_a_frame_is_replaced() -> None:
    params, (tokens, mask, actions) = random_params(DUAL), random_inputs(DUAL)
    draft, _, _ = random_inputs(DUAL, seed=1)
    whole = forward(DUAL, params, (tokens, mask, actions))
    cache, first = empty_cache(DUAL, BATCH, DUAL.frames), slice(0, 3)
    for given in (draft, tokens):
        piece = {name: x[:, first] for name, x in given.items()}
        _, cache = apply(DUAL, params, piece, mask[:, first], actions[:, first], 0, cache)
    rest = slice(3, None)
    logits, _ = apply(
        DUAL, params, {n: x[:, rest] for n, x in tokens.items()}, mask[:, rest], actions[:, rest], 3, cache
    )
    for name in whole:
        np.testing.assert_allclose(logits[name], whole[name][:, rest], rtol=1e-4, atol=1e-4)


@pytest.mark.usefixtures("bf16_units")
def test_bfloat16_computes_nearly_the_same_and_gives_float32() -> None:
    params, inputs = jax.jit(Transformer(DUAL).init_params)(jax.random.key(0)), random_inputs(DUAL)
    exact, rough = forward(DUAL, params, inputs), forward(replace(DUAL, compute_dtype="bfloat16"), params, inputs)
    for name in exact:
        assert rough[name].dtype == jnp.float32
        assert 0 < np.abs(rough[name] - exact[name]).max() < 0.1
