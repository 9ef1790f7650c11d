import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import ml_dtypes
import numpy as np
import pytest

from rsjax.config import Departures, PublicCodeConfig
from rsjax.errors import UserError
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Transformer
from rsjax.tools.convert.files import ConvertError
from rsjax.tools.convert.genie import from_public, infer_config, name_table, read_settings, settings_of
from rsjax.tools.convert.table import public_shapes, to_tensors
from tests.tools.convert.public import GenieNet, Tensors, genie_shapes, random_tensors

LAYERS = 3
WIDTH = 16
HEADS = 2
FRAMES = 3
CELLS = 4
CODES = 8
SETTINGS = {"num_layers": LAYERS, "num_heads": HEADS, "d_model": WIDTH, "image_vocab_size": CODES**2, "S": CELLS}


def tensors(qk_norm: bool = False) -> Tensors:
    return random_tensors(genie_shapes(LAYERS, WIDTH, HEADS, FRAMES, CELLS, CODES, qk_norm))


def source(tmp_path: Path) -> Path:
    return tmp_path / "model.safetensors"


@pytest.mark.parametrize(("width", "qk_norm", "published"), [(256, True, None), (512, False, 137_545_216)])
def test_the_published_sizes_have_the_published_names_and_shapes(
    width: int, qk_norm: bool, published: int | None
) -> None:
    config = Architecture(width=width, depth="none", action_inputs=0, public_code=PublicCodeConfig(qk_norm))
    shapes = public_shapes(name_table(config), jax.eval_shape(Transformer(config).init_params, jax.random.key(0)))
    assert shapes == genie_shapes(32, width, 8, 16, 256, 512, qk_norm)
    if published:
        assert sum(int(np.prod(shape)) for shape in shapes.values()) == published


@pytest.mark.parametrize(("qk_norm", "mup"), [(False, False), (True, True)], ids=["plain", "qk-norm and muP"])
def test_the_converted_model_computes_what_the_published_one_does(qk_norm: bool, mup: bool) -> None:
    public = tensors(qk_norm)
    rng = np.random.default_rng(0)
    config, params = from_public(Path("file"), public, SETTINGS | {"use_mup": mup, "qk_norm": qk_norm})
    assert (config.public.mup, config.public.qk_norm) == (mup, qk_norm)
    assert (config.action_inputs, config.depth) == (0, "none")
    tokens = rng.integers(0, CODES**2, (2, FRAMES, 2, 2), np.int32)
    mask = rng.random(tokens.shape) < 0.4
    logits, _ = jax.jit(lambda *x: Transformer(config).apply({"params": params}, *x))({"rgb": tokens}, mask, None)
    flat = (2, FRAMES, CELLS)
    expected = GenieNet(public, LAYERS, HEADS, mup).logits(tokens.reshape(flat), mask.reshape(flat))
    np.testing.assert_allclose(logits["rgb"], expected, rtol=1e-4, atol=1e-4)
    assert expected.std() > 0.1


def test_export_inverts_import() -> None:
    public = tensors(qk_norm=True)
    config, params = from_public(Path("file"), public, SETTINGS)
    again = to_tensors(params, name_table(config))
    assert again.keys() == public.keys()
    for name in public:
        assert again[name].dtype == public[name].dtype
        np.testing.assert_array_equal(again[name], public[name], err_msg=name)
    settings = settings_of(config)
    assert infer_config(Path("file"), again, settings) == config
    assert settings.items() >= SETTINGS.items()


def test_heads_are_inferred_from_qk_norm_only() -> None:
    assert infer_config(Path("file"), tensors(qk_norm=True), {}).heads == HEADS
    assert infer_config(Path("file"), tensors(), {}, heads=4).heads == 4


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_heads": None}, "attention heads is unknown; .* or set --heads"),
        ({"num_heads": -2}, "attention heads is -2"),
        ({"num_layers": 4}, "config.json.*num_layers is 4, not"),
        ({"qk_norm": True}, "config.json.*qk_norm is True, not"),
        ({"mlp_ratio": 2.0}, "config.json.*mlp_ratio is 2.0, not"),
        ({"qkv_bias": True}, "config.json: qkv_bias true is not supported"),
        ({"proj_bias": False}, "config.json: proj_bias false is not supported"),
        ({"use_mup": "false"}, 'config.json: use_mup is "false", not true or false'),
        ({"use_mup": 0}, "config.json: use_mup is 0, not true or false"),
        ({"num_heads": True}, "config.json: num_heads is true, not a whole number"),
        ({"num_layers": 3.0}, "config.json: num_layers is 3.0, not a whole number"),
        ({"T": [3]}, r"config.json: T is \[3\], not a whole number"),
        ({"mlp_ratio": "4"}, 'config.json: mlp_ratio is "4", not a number'),
        ({"attn_drop": False}, "config.json: attn_drop is false, not a number"),
    ],
    ids=str,
)
def test_settings_that_do_not_fit_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConvertError, match=message):
        infer_config(Path("file"), tensors(), SETTINGS | settings)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("pos_embed_TSC", np.zeros(()), "module.pos_embed_TSC is"),
        ("pos_embed_TSC", np.zeros((0, 0, 0, 0)), "module.pos_embed_TSC is"),
        ("token_embed.factored_embeds.0.weight", np.zeros((2,) * 5), "module.token_embed.factored_embeds.0.weight is"),
        ("out_x_proj.bias", np.zeros(0), "module.out_x_proj.bias is"),
        ("out_x_proj.bias", np.zeros(16, np.int64), "not floats: module.out_x_proj.bias is int64$"),
        ("out_x_proj.bias", np.full(16, -np.inf, ml_dtypes.bfloat16), "infinite values: module.out_x_proj.bias$"),
        ("out_x_proj.bias", np.full(16, 1e300), "NaN or infinite values: module.out_x_proj.bias$"),
    ],
)
def test_weights_that_do_not_fit_are_named_as_in_the_file(key: str, value: np.ndarray, message: str) -> None:
    names = {name: f"module.{name}" for name in tensors()}
    with pytest.raises(ConvertError, match=f"^file: .*{message}"):
        from_public(Path("file"), tensors() | {key: value}, SETTINGS, names=names)


def test_frames_that_are_not_square_are_one_line() -> None:
    wide = random_tensors(genie_shapes(LAYERS, WIDTH, HEADS, FRAMES, 6, CODES, False))
    with pytest.raises(ConvertError) as error:
        from_public(Path("file"), wide, SETTINGS | {"S": 6})
    assert str(error.value) == (
        "file: its tensors do not fit the network inferred from them; of another shape: pos_embed_TSC is "
        "(1, 3, 6, 16), not (1, 3, 4, 16)"
    )


def test_settings_of_training_are_ignored() -> None:
    more = SETTINGS | {"max_corrupt_rate": 0.3, "attn_drop": 0.1, "factored_vocab_size": None, "qkv_bias": None}
    assert infer_config(Path("file"), tensors(), more) == infer_config(Path("file"), tensors(), SETTINGS)


def test_settings_are_read_from_beside_the_weights(tmp_path: Path) -> None:
    assert read_settings(source(tmp_path)) == {}
    beside = tmp_path / "config.json"
    beside.write_text(json.dumps(SETTINGS))
    assert read_settings(source(tmp_path)) == SETTINGS
    for damaged, message in (("{", "config.json"), ("[1]", "config.json"), ('{"model_type": "llama"}', "not a Genie")):
        beside.write_text(damaged)
        with pytest.raises(UserError, match=message):
            read_settings(source(tmp_path))
    with pytest.raises(ConvertError, match="no weights of a Genie"):
        infer_config(Path("file"), {"encoder.conv_in.weight": np.zeros((4, 3, 3, 3))}, SETTINGS)


@pytest.mark.parametrize(
    "fields",
    [
        {"depth": "branch"},
        {"action_inputs": 7},
        {"departures": Departures(rotary=True)},
    ],
    ids=str,
)
def test_a_model_without_public_names_is_not_exported(fields: dict[str, Any]) -> None:
    config = replace(Architecture(width=16, blocks=2, heads=2, depth="none", action_inputs=0), **fields)
    params = jax.eval_shape(Transformer(config).init_params, jax.random.key(0))
    with pytest.raises(ConvertError, match="no name for these parts|cannot express model.departures.rotary"):
        to_tensors(params, name_table(config))
