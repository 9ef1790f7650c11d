import math
from dataclasses import replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import ModelConfig
from rsjax.model.world_model import WorldModel, branches, empty_cache

DUAL = ModelConfig(frames=5, grid=2, code_bits=4, action_dim=3, width=8, blocks=2, heads=2)
RGB = replace(DUAL, depth=False)
NORMED = replace(DUAL, temporal_norm=True, final_norm=True)
QK_NORM = replace(DUAL, qk_norm=True, mup=True)
GENIE = replace(RGB, action_dim=0)
GUIDED = replace(DUAL, action_dropout=0.5)
BATCH = 2


def forward(config: ModelConfig, params: Any, inputs: tuple) -> dict[str, np.ndarray]:
    logits, cache = _apply(config, params, *inputs)
    assert cache is None
    return jax.tree.map(np.asarray, logits)


def _apply_plain(
    config: ModelConfig,
    params: Any,
    tokens: Any,
    mask: Any,
    actions: Any,
    start: Any = 0,
    cache: Any = None,
    drop_actions: Any = None,
):
    return WorldModel(config).apply({"params": params}, tokens, mask, actions, start, cache, drop_actions)


_apply = jax.jit(_apply_plain, static_argnums=0)


def random_params(config: ModelConfig) -> Any:
    """Parameters without a zero among them, so that nothing hides behind an initial value."""
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(WorldModel(config).init_params, jax.random.key(0))
    return jax.tree.map(lambda x: rng.normal(scale=0.4, size=x.shape).astype(np.float32), shapes)


def random_inputs(config: ModelConfig, seed: int = 0) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    shape = (BATCH, config.frames, config.grid, config.grid)
    tokens = {name: rng.integers(0, 2**config.code_bits, shape, np.int32) for name in branches(config)}
    return (
        tokens,
        rng.random(shape) < 0.4,
        rng.normal(size=(BATCH, config.frames, config.action_dim)).astype(np.float32),
    )


# The model once more, cell by cell, from the paper's §2.3 and the public Genie's layout.


def softmax(x: np.ndarray) -> np.ndarray:
    e = np.exp(x - x.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def gelu(x: np.ndarray) -> np.ndarray:
    return x * 0.5 * (1 + np.vectorize(math.erf)(x / math.sqrt(2)))


def layer_norm(x: np.ndarray, p: dict) -> np.ndarray:
    centred = x - x.mean(-1, keepdims=True)
    return centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-5) * p["scale"] + p["bias"]


def sequence_attention(x: np.ndarray, p: dict, config: ModelConfig, causal: bool) -> np.ndarray:
    """Attention over one sequence (L, C)."""
    length, width = x.shape
    heads = config.heads
    qkv = (x @ p["qkv"]["kernel"]).reshape(length, 3, heads, width // heads)
    if config.qk_norm:
        qkv[:, :2] = layer_norm(qkv[:, :2], p["norm"])
    scale = 8 / (width // heads) if config.mup else 1 / math.sqrt(width // heads)
    out = np.zeros((length, heads, width // heads))
    for head in range(heads):
        for i in range(length):
            last = i + 1 if causal else length
            scores = qkv[:last, 1, head] @ qkv[i, 0, head] * scale
            out[i, head] = softmax(scores) @ qkv[:last, 2, head]
    return out.reshape(length, width) @ p["proj"]["kernel"] + p["proj"]["bias"]


def st_block(x: np.ndarray, p: dict, config: ModelConfig) -> np.ndarray:
    x = x.copy()
    b, t, s, _ = x.shape
    normed = x.copy() if config.qk_norm else layer_norm(x, p["norm1"])
    x += [[sequence_attention(normed[i, j], p["spatial_attn"], config, False) for j in range(t)] for i in range(b)]
    before = layer_norm(x, p["norm_temporal"]) if config.temporal_norm else x.copy()
    for i in range(b):
        for cell in range(s):
            x[i, :, cell] += sequence_attention(before[i, :, cell], p["temporal_attn"], config, True)
    normed = x if config.qk_norm else layer_norm(x, p["norm2"])
    hidden = gelu(normed @ p["fc1"]["kernel"] + p["fc1"]["bias"])
    return x + hidden @ p["fc2"]["kernel"] + p["fc2"]["bias"]


def plain_forward(config: ModelConfig, params: Any, inputs: tuple) -> dict[str, np.ndarray]:
    tokens, mask, actions = inputs
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), params)
    b, t = mask.shape[:2]
    h = {}
    for name, grid in tokens.items():
        embed = p[f"{name}_embed"]
        flat = grid.reshape(b, t, -1)
        x = sum(
            embed[f"factored_embed_{k}"]["embedding"][(flat // config.vocabulary_size**k) % config.vocabulary_size]
            for k in range(config.vocabularies)
        )
        x[mask.reshape(b, t, -1)] = embed["mask_token_embed"]
        h[name] = x + p["pos_embed"][:t]
        if config.action_dim:
            h[name] += (actions @ p["action_encoder"]["kernel"] + p["action_encoder"]["bias"])[:, :, None]
    for block in range(config.blocks):
        own = jax.tree.map(lambda x, block=block: x[block], p["blocks"])
        h = {name: st_block(x, own[name], config) for name, x in h.items()}
        if config.depth:
            h["rgb"] = h["rgb"] + h["depth"] @ own["depth_to_rgb"]["kernel"] + own["depth_to_rgb"]["bias"]
    if config.final_norm:
        h = {name: layer_norm(x, p[f"{name}_norm_out"]) for name, x in h.items()}
    if config.mup:
        h = {name: x * 256 / config.width for name, x in h.items()}
    logits = {name: x @ p[f"{name}_head"]["kernel"] + p[f"{name}_head"]["bias"] for name, x in h.items()}
    return {name: x.reshape(*x.shape[:3], config.vocabularies, config.vocabulary_size) for name, x in logits.items()}


CONFIGS = {"dual": DUAL, "rgb": RGB, "normed": NORMED, "qk-norm": QK_NORM, "genie": GENIE}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_logits_are_those_of_the_plain_computation(config: ModelConfig) -> None:
    params, inputs = random_params(config), random_inputs(config)
    logits, expected = forward(config, params, inputs), plain_forward(config, params, inputs)
    assert logits.keys() == expected.keys()
    for name in logits:
        np.testing.assert_allclose(logits[name], expected[name], rtol=1e-3, atol=1e-3, err_msg=name)


def count(params: Any) -> int:
    return sum(x.size for x in jax.tree.leaves(params))


@pytest.mark.parametrize(("width", "published"), [(256, 35_218_688), (512, 137_545_216)])
def test_one_branch_without_actions_has_the_published_size(width: int, published: int) -> None:
    config = ModelConfig(width=width, depth=False, action_dim=0)
    params = jax.eval_shape(WorldModel(config).init_params, jax.random.key(0))
    assert count(params) == published

    dual = jax.eval_shape(WorldModel(replace(config, depth=True)).init_params, jax.random.key(0))
    assert count(dual) == 2 * published - count(params["pos_embed"]) + config.blocks * (width + 1) * width


def test_qk_norm_trades_two_norms_of_the_width_for_two_of_a_head() -> None:
    block = jax.eval_shape(WorldModel(QK_NORM).init_params, jax.random.key(0))["blocks"]["rgb"]
    assert not {"norm1", "norm2"} & block.keys()
    for attention in ("spatial_attn", "temporal_attn"):
        assert block[attention]["norm"]["scale"].shape == (QK_NORM.blocks, QK_NORM.width // QK_NORM.heads)


def test_without_an_action_encoder_actions_are_not_read() -> None:
    params, (tokens, mask, actions) = random_params(GENIE), random_inputs(GENIE)
    assert actions.shape[-1] == 0
    expected = forward(GENIE, params, (tokens, mask, actions))["rgb"]
    for other in (None, random_inputs(DUAL)[2]):
        np.testing.assert_array_equal(forward(GENIE, params, (tokens, mask, other))["rgb"], expected)


def test_a_dropped_clip_sees_the_null_action_in_every_frame_and_the_others_their_own() -> None:
    params, (tokens, mask, actions) = random_params(GUIDED), random_inputs(GUIDED)
    drop = np.array([True, False])
    dropped, _ = _apply(GUIDED, params, tokens, mask, actions, 0, None, drop)
    own = forward(GUIDED, params, (tokens, mask, actions))
    null = dict(params, action_encoder={"kernel": np.zeros((3, 8), np.float32), "bias": params["null_action"]})
    without = forward(GUIDED, null, (tokens, mask, actions))
    for name in own:
        np.testing.assert_allclose(dropped[name][0], without[name][0], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(dropped[name][1], own[name][1], rtol=1e-4, atol=1e-4)
        assert not np.allclose(own[name][0], without[name][0], atol=0.1)


def test_actions_cannot_be_dropped_without_a_null_action() -> None:
    with pytest.raises(ValueError, match="model.action_dropout"):
        _apply_plain(DUAL, random_params(DUAL), *random_inputs(DUAL), drop_actions=np.array([True, False]))


@pytest.mark.parametrize("remat", ["products", "blocks"])
def test_remat_changes_neither_parameters_nor_gradients(remat: Literal["products", "blocks"]) -> None:
    params, inputs = random_params(DUAL), random_inputs(DUAL)

    def gradients(config: ModelConfig) -> Any:
        loss = lambda params: sum(jnp.mean(jnp.square(x)) for x in _apply_plain(config, params, *inputs)[0].values())  # noqa: E731
        return jax.jit(jax.grad(loss))(params)

    plain, again = gradients(DUAL), gradients(replace(DUAL, remat=remat))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), plain, again)


def test_of_the_remat_policies_each_keeps_less_than_the_one_before() -> None:
    params, inputs = random_params(DUAL), random_inputs(DUAL)

    def kept(remat: Literal["none", "products", "blocks"]) -> int:
        forward = lambda params: _apply_plain(replace(DUAL, remat=remat), params, *inputs)[0]  # noqa: E731
        return sum(x.size for x in jax.tree.leaves(jax.eval_shape(lambda p: jax.vjp(forward, p)[1], params)))

    assert kept("none") > kept("products") > kept("blocks")


def test_without_depth_nothing_of_it_exists() -> None:
    params = jax.eval_shape(WorldModel(RGB).init_params, jax.random.key(0))
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


def test_an_action_reaches_the_frame_that_it_led_into() -> None:
    params, (tokens, mask, actions) = random_params(DUAL), random_inputs(DUAL)
    other = actions.copy()
    other[:, 3] += 1
    change = {
        name: np.abs(x - forward(DUAL, params, (tokens, mask, other))[name]).max(axis=(0, 2, 3, 4))
        for name, x in forward(DUAL, params, (tokens, mask, actions)).items()
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
    params = jax.jit(WorldModel(DUAL).init_params)(jax.random.key(0))
    assert not any(np.any(x) for x in jax.tree.leaves(params["blocks"]["depth_to_rgb"]))
    kernels = params["blocks"]["rgb"]["fc1"]["kernel"]
    assert not np.allclose(kernels[0], kernels[1])  # blocks are drawn apart


def test_depth_never_reads_rgb() -> None:
    params, (tokens, mask, actions) = random_params(DUAL), random_inputs(DUAL)
    others, _, _ = random_inputs(DUAL, seed=1)
    before, after = (forward(DUAL, params, (x, mask, actions)) for x in (tokens, tokens | {"rgb": others["rgb"]}))
    np.testing.assert_array_equal(before["depth"], after["depth"])
    assert not np.allclose(before["rgb"], after["rgb"])


@pytest.mark.parametrize("config", [DUAL, RGB, QK_NORM], ids=["dual", "rgb", "qk-norm"])
@pytest.mark.parametrize("pieces", [(5,), (1, 1, 1, 1, 1), (2, 3)], ids=str)
def test_pieces_through_the_cache_are_the_whole(config: ModelConfig, pieces: tuple[int, ...]) -> None:
    params, (tokens, mask, actions) = random_params(config), random_inputs(config)
    whole = forward(config, params, (tokens, mask, actions))
    cache, start = empty_cache(config, BATCH, config.frames), 0
    for length in pieces:
        here = slice(start, start + length)
        piece = ({name: x[:, here] for name, x in tokens.items()}, mask[:, here], actions[:, here])
        logits, cache = _apply(config, params, *piece, start, cache)
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
        _, cache = _apply(DUAL, params, piece, mask[:, first], actions[:, first], 0, cache)
    rest = slice(3, None)
    logits, _ = _apply(
        DUAL, params, {n: x[:, rest] for n, x in tokens.items()}, mask[:, rest], actions[:, rest], 3, cache
    )
    for name in whole:
        np.testing.assert_allclose(logits[name], whole[name][:, rest], rtol=1e-4, atol=1e-4)


def test_bfloat16_computes_nearly_the_same_and_gives_float32() -> None:
    params, inputs = jax.jit(WorldModel(DUAL).init_params)(jax.random.key(0)), random_inputs(DUAL)
    exact, rough = forward(DUAL, params, inputs), forward(replace(DUAL, compute_dtype="bfloat16"), params, inputs)
    for name in exact:
        assert rough[name].dtype == jnp.float32
        assert 0 < np.abs(rough[name] - exact[name]).max() < 0.1
