from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import TokenizerConfig
from rsjax.config.presets import PRESETS
from rsjax.tokenizers.magvit2 import (
    MagvitDecoder,
    MagvitEncoder,
    MagvitResBlock,
    Tokenizer,
    depth_to_space,
    space_to_depth,
    to_pixels,
    to_unit,
)

SMALL = TokenizerConfig(patch_size=2, channels=8, channel_multipliers=(1, 2), res_blocks=1, norm_groups=4, code_bits=6)


def random_params(init: Callable[[Any], Any]) -> Any:
    """Parameters of the shapes that ``init`` makes, without a zero or a one among them, and none of its time."""
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(init, jax.random.key(0))
    return jax.tree.map(lambda x: rng.normal(scale=0.2, size=x.shape).astype(np.float32), shapes)


@pytest.fixture(scope="module")
def params() -> Any:
    return random_params(Tokenizer(SMALL).init_params)


encode = jax.jit(partial(Tokenizer(SMALL).apply, method="encode"))
decode = jax.jit(partial(Tokenizer(SMALL).apply, method="decode"))


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (3, 16, 16, 3), np.uint8)


def conv3(x: np.ndarray, kernel: np.ndarray, stride: int = 1) -> np.ndarray:
    """Cross-correlation with one pixel of zeros on every side."""
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    rows, columns = (range(0, size, stride) for size in x.shape[1:3])
    return np.stack(
        [
            np.stack([np.einsum("bijc,ijco->bo", padded[:, r : r + 3, c : c + 3], kernel) for c in columns], axis=1)
            for r in rows
        ],
        axis=1,
    )


def group_norm(x: np.ndarray, groups: int, scale: np.ndarray, bias: np.ndarray) -> np.ndarray:
    grouped = x.reshape(x.shape[0], -1, groups, x.shape[-1] // groups)
    mean, var = (f(grouped, axis=(1, 3), keepdims=True) for f in (np.mean, np.var))
    return ((grouped - mean) / np.sqrt(var + 1e-6)).reshape(x.shape) * scale + bias


def swish(x: np.ndarray) -> np.ndarray:
    return x / (1 + np.exp(-x))


@pytest.mark.parametrize(
    ("config", "published"),
    [
        (TokenizerConfig(), {"encoder": (87, 24_964_498), "decoder": (88, 40_526_211)}),
        (
            TokenizerConfig(res_blocks=4, adaptive_norm=True),
            {"encoder": (159, 49_751_442), "decoder": (180, 65_376_387)},
        ),
    ],
    ids=["256_B", "256_L"],
)
def test_both_generations_have_the_published_encoder_and_decoder(
    config: TokenizerConfig, published: dict[str, tuple[int, int]]
) -> None:
    shapes = jax.eval_shape(Tokenizer(config).init_params, jax.random.key(0))
    counted = {part: (len(jax.tree.leaves(x)), sum(p.size for p in jax.tree.leaves(x))) for part, x in shapes.items()}
    assert counted == published


USED = {(p.tokenizer, p.clips.image_size): name for name, p in PRESETS.items() if p.autoencoder is p.tokenizer}


@pytest.mark.parametrize(("config", "size"), USED, ids=USED.values())
def test_tokens_and_images_have_the_presets_shapes(config: TokenizerConfig, size: int) -> None:
    model, grid = Tokenizer(config), config.grid(size)
    shapes = jax.eval_shape(model.init_params, jax.random.key(0))
    image = jax.ShapeDtypeStruct((2, size, size, 3), jnp.uint8)
    tokens = jax.eval_shape(lambda p, x: model.apply({"params": p}, x, method="encode"), shapes, image)
    assert (tokens.shape, tokens.dtype) == ((2, grid, grid), jnp.int32)
    decoded = jax.eval_shape(lambda p, x: model.apply({"params": p}, x, method="decode"), shapes, tokens)
    assert (decoded.shape, decoded.dtype) == (image.shape, jnp.float32)


def test_space_to_depth_and_back() -> None:
    x = np.random.default_rng(0).normal(size=(2, 8, 4, 3))
    np.testing.assert_array_equal(depth_to_space(space_to_depth(jnp.array(x), 4), 4), jnp.array(x))


def test_depth_to_space_puts_row_then_column_before_channel() -> None:
    x = np.arange(2 * 3 * 2 * 4 * 5).reshape(2, 3, 2, 4 * 5)
    out = np.asarray(depth_to_space(jnp.array(x), 2))
    for i in range(2):
        for j in range(2):
            for c in range(5):
                np.testing.assert_array_equal(out[:, i::2, j::2, c], x[..., (2 * i + j) * 5 + c])


@pytest.mark.parametrize("features", [8, 12])
def test_a_residual_block_is_the_plain_computation(features: int) -> None:
    x = np.random.default_rng(1).normal(size=(2, 4, 4, 8)).astype(np.float32)
    block = MagvitResBlock(features, 4, "float32")
    p = random_params(lambda key: block.init(key, x)["params"])
    out = jax.jit(block.apply)({"params": p}, x)
    h = conv3(swish(group_norm(x, 4, p["norm1"]["scale"], p["norm1"]["bias"])), p["conv1"]["kernel"])
    h = conv3(swish(group_norm(h, 4, p["norm2"]["scale"], p["norm2"]["bias"])), p["conv2"]["kernel"])
    shortcut = x @ p["nin_shortcut"]["kernel"][0, 0] if features != 8 else x
    np.testing.assert_allclose(out, shortcut + h, rtol=1e-4, atol=1e-4)
    assert set(p["conv1"]) == {"kernel"}


def test_downsampling_pads_all_four_sides(params: Any) -> None:
    x = jax.random.normal(jax.random.key(1), (2, 16, 16, 3))
    apply = jax.jit(partial(MagvitEncoder(SMALL).apply, capture_intermediates=True))
    _, state = apply({"params": params["encoder"]}, x)
    seen = {
        name: np.asarray(value["__call__"][0]) for name, value in state["intermediates"].items() if name[:2] == "do"
    }
    p = jax.tree.map(np.asarray, params["encoder"]["down_0_downsample"])
    by_hand = conv3(seen["down_0_block_0"], p["kernel"], stride=2) + p["bias"]
    np.testing.assert_allclose(seen["down_0_downsample"], by_hand, rtol=1e-4, atol=1e-5)


def test_adaptive_norm_scales_and_shifts_each_level_by_the_codes_statistics() -> None:
    config = replace(SMALL, adaptive_norm=True)
    p = random_params(Tokenizer(config).init_params)["decoder"]
    codes = np.sign(np.random.default_rng(2).normal(size=(2, 4, 4, 6))).astype(np.float32)
    apply = jax.jit(partial(MagvitDecoder(config).apply, capture_intermediates=True))
    _, state = apply({"params": p}, codes)
    seen = {name: np.asarray(value["__call__"][0]) for name, value in state["intermediates"].items() if name[0] != "_"}
    before = {
        "adaptive_1": seen["mid_block_0"],
        "adaptive_0": np.asarray(depth_to_space(jnp.array(seen["up_1_upsample"]), 2)),
    }
    mean = codes.mean((1, 2))
    deviation = np.sqrt(((codes - mean[:, None, None]) ** 2).sum((1, 2)) / (4 * 4 - 1) + 1e-6)
    for name, x in before.items():
        gamma, beta = (
            statistic @ p[name][part]["kernel"] + p[name][part]["bias"]
            for part, statistic in (("gamma", deviation), ("beta", mean))
        )
        by_hand = (
            gamma[:, None, None] * group_norm(x, 4, np.ones(x.shape[-1]), np.zeros(x.shape[-1])) + beta[:, None, None]
        )
        np.testing.assert_allclose(seen[name], by_hand, rtol=1e-3, atol=1e-4, err_msg=name)


def test_tokens_spell_the_signs_of_the_latents(params: Any, images: np.ndarray) -> None:
    tokens = encode({"params": params}, images)
    reconstruction, latents = jax.jit(Tokenizer(SMALL).apply)({"params": params}, images / np.float32(127.5) - 1)
    spelt = sum((np.asarray(latents[..., c]) > 0) * 2**c for c in range(SMALL.code_bits))
    np.testing.assert_array_equal(tokens, spelt)
    decoded = decode({"params": params}, tokens)
    np.testing.assert_allclose(decoded, np.clip((reconstruction + 1) * 127.5, 0, 255), atol=1e-2)


def test_decoded_images_stay_within_the_pixel_range(params: Any, images: np.ndarray) -> None:
    loud = jax.tree.map(lambda x: 10 * x, params)
    tokens = encode({"params": loud}, images)
    decoded = np.asarray(decode({"params": loud}, tokens))
    assert (decoded.min(), decoded.max()) == (0.0, 255.0)


def test_pixels_survive_the_unit_range() -> None:
    pixels = np.arange(256, dtype=np.uint8)
    unit = to_unit(pixels)
    assert (unit[0], unit[-1]) == (-1.0, 1.0)
    np.testing.assert_array_equal(np.round(to_pixels(unit)), pixels)


@pytest.mark.parametrize("local", [True, False])
def test_local_codes_depend_on_their_own_pixels_alone(local: bool, images: np.ndarray) -> None:
    config = replace(SMALL, local_codes=local)
    params = random_params(Tokenizer(config).init_params)
    changed = images.copy()
    changed[:, 4:8, 8:12] = 255 - changed[:, 4:8, 8:12]  # the pixels of the cell in row 1, column 2
    before, after = (
        np.asarray(MagvitEncoder(config).apply({"params": params["encoder"]}, to_unit(x))) for x in (images, changed)
    )
    differ = np.argwhere(np.any(np.abs(before - after) > 1e-6, axis=(0, 3))).tolist()
    assert [1, 2] in differ
    assert (differ == [[1, 2]]) == local
