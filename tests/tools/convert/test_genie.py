import json
import re
from pathlib import Path
from typing import Any

import jax
import ml_dtypes
import numpy as np
import pytest

from rsjax.config import Departures
from rsjax.errors import UserError
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Transformer
from rsjax.tools.convert.files import ConvertError
from rsjax.tools.convert.genie import from_public, infer_config, read_settings, settings_of, table
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


@pytest.mark.parametrize(("width", "published"), [(256, 35_218_688), (512, 137_545_216)])
@pytest.mark.parametrize("qk_norm", [False, True])
def test_the_published_sizes_have_the_published_names_and_shapes(width: int, published: int, qk_norm: bool) -> None:
    config = Architecture(width=width, use_depth=False, action_inputs=0, qk_norm=qk_norm)
    shapes = public_shapes(table(config), jax.eval_shape(Transformer(config).init_params, jax.random.key(0)))
    assert shapes == genie_shapes(32, width, 8, 16, 256, 512, qk_norm)
    if not qk_norm:
        assert sum(int(np.prod(shape)) for shape in shapes.values()) == published


@pytest.mark.parametrize(("qk_norm", "mup"), [(False, False), (True, True)], ids=["plain", "qk-norm and muP"])
def test_the_converted_model_computes_what_the_published_one_does(qk_norm: bool, mup: bool) -> None:
    public = tensors(qk_norm)
    rng = np.random.default_rng(0)
    config, params = from_public(Path("file"), public, SETTINGS | {"use_mup": mup, "qk_norm": qk_norm})
    assert (config.mup, config.qk_norm, config.action_inputs, config.use_depth) == (mup, qk_norm, 0, False)
    tokens = rng.integers(0, CODES**2, (2, FRAMES, 2, 2), np.int32)
    mask = rng.random(tokens.shape) < 0.4
    logits, _ = jax.jit(lambda *x: Transformer(config).apply({"params": params}, *x))({"rgb": tokens}, mask, None)
    flat = (2, FRAMES, CELLS)
    expected = GenieNet(public, LAYERS, HEADS, mup).logits(tokens.reshape(flat), mask.reshape(flat))
    np.testing.assert_allclose(logits["rgb"], expected, rtol=1e-4, atol=1e-4)
    assert expected.std() > 0.1


@pytest.mark.parametrize("qk_norm", [False, True])
def test_export_inverts_import(qk_norm: bool) -> None:
    public = tensors(qk_norm)
    config, params = from_public(Path("file"), public, SETTINGS)
    again = to_tensors(params, table(config))
    assert again.keys() == public.keys()
    for name in public:
        assert again[name].dtype == public[name].dtype
        np.testing.assert_array_equal(again[name], public[name], err_msg=name)
    settings = settings_of(config)
    assert infer_config(Path("file"), again, settings) == config
    assert settings.items() >= SETTINGS.items()


def test_heads_are_inferred_from_qk_norm_only() -> None:
    assert infer_config(Path("file"), tensors(qk_norm=True), {}).heads == HEADS
    with pytest.raises(ConvertError, match="--heads"):
        infer_config(Path("file"), tensors(), {})
    assert infer_config(Path("file"), tensors(), {}, heads=4).heads == 4
    with pytest.raises(ConvertError, match="heads is -2"):
        infer_config(Path("file"), tensors(), {}, heads=-2)


@pytest.mark.parametrize(("field", "value"), [("num_layers", 4), ("qk_norm", True), ("T", 9), ("mlp_ratio", 2.0)])
def test_settings_that_contradict_the_weights_are_named(field: str, value: Any) -> None:
    with pytest.raises(ConvertError, match=f"config.json.*{field} is {value}, not"):
        infer_config(Path("file"), tensors(), SETTINGS | {field: value})


@pytest.mark.parametrize(("field", "value"), [("qkv_bias", True), ("proj_bias", False), ("mlp_bias", False)])
def test_unsupported_settings_are_refused(field: str, value: bool) -> None:
    with pytest.raises(ConvertError, match=f"config.json: {field} {str(value).lower()} is not supported"):
        infer_config(Path("file"), tensors(), SETTINGS | {field: value})


@pytest.mark.parametrize(
    ("field", "value", "kind"),
    [
        ("use_mup", "false", "true or false"),
        ("use_mup", 0, "true or false"),
        ("qk_norm", "no", "true or false"),
        ("num_heads", True, "a whole number"),
        ("num_heads", "2", "a whole number"),
        ("num_layers", 3.0, "a whole number"),
        ("T", [3], "a whole number"),
        ("mlp_ratio", "4", "a number"),
        ("attn_drop", False, "a number"),
    ],
)
def test_settings_of_another_type_are_refused(field: str, value: Any, kind: str) -> None:
    with pytest.raises(ConvertError, match=rf"config.json: {field} is {re.escape(json.dumps(value))}, not {kind}"):
        infer_config(Path("file"), tensors(), SETTINGS | {field: value})


@pytest.mark.parametrize("key", ["pos_embed_TSC", "token_embed.factored_embeds.0.weight", "out_x_proj.bias"])
@pytest.mark.parametrize("shape", [(), (0,), (0, 0, 0, 0), (2, 2, 2, 2, 2)], ids=str)
def test_tensors_of_unexpected_shapes_are_named(key: str, shape: tuple[int, ...]) -> None:
    names = {name: f"module.{name}" for name in tensors()}
    with pytest.raises(ConvertError, match=f"file: .*module.{re.escape(key)} is"):
        from_public(Path("file"), tensors() | {key: np.zeros(shape, np.float32)}, SETTINGS, names=names)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros(16, np.int64), "not floats: module.out_x_proj.bias is int64"),
        (np.zeros(16, bool), "not floats: module.out_x_proj.bias is bool"),
        (np.zeros(16, np.complex64), "not floats: module.out_x_proj.bias is complex64"),
        (np.full(16, np.nan, np.float16), "with NaN or infinite values: module.out_x_proj.bias"),
        (np.full(16, -np.inf, ml_dtypes.bfloat16), "with NaN or infinite values: module.out_x_proj.bias"),
        (np.full(16, 1e300), "with NaN or infinite values: module.out_x_proj.bias"),
    ],
    ids=["integers", "booleans", "complex", "NaN", "infinite bfloat16", "beyond float32"],
)
def test_weights_that_are_no_finite_floats_are_refused(value: np.ndarray, message: str) -> None:
    with pytest.raises(ConvertError, match=f"^file: .*{message}$"):
        from_public(
            Path("file"),
            tensors() | {"out_x_proj.bias": value},
            SETTINGS,
            names={"out_x_proj.bias": "module.out_x_proj.bias"},
        )


def test_settings_of_training_are_ignored() -> None:
    more = SETTINGS | {"max_corrupt_rate": 0.3, "attn_drop": 0.1, "factored_vocab_size": None, "qkv_bias": None}
    assert infer_config(Path("file"), tensors(), more) == infer_config(Path("file"), tensors(), SETTINGS)


def test_settings_are_read_from_beside_the_weights(tmp_path: Path) -> None:
    assert read_settings(source(tmp_path)) == {}
    beside = tmp_path / "config.json"
    beside.write_text(json.dumps(SETTINGS))
    assert read_settings(source(tmp_path)) == SETTINGS
    for damaged in ("{", "[1]"):
        beside.write_text(damaged)
        with pytest.raises(UserError, match="config.json"):
            read_settings(source(tmp_path))


def test_a_config_json_of_something_else_is_refused(tmp_path: Path) -> None:
    beside = tmp_path / "config.json"
    for name in ("num_layers", "num_heads"):
        beside.write_text(json.dumps({name: 2}))
        assert read_settings(source(tmp_path)) == {name: 2}
    for other in ({}, {"model_type": "llama", "d_model": WIDTH}):
        beside.write_text(json.dumps(other))
        with pytest.raises(ConvertError, match="config.json: not a GenieConfig"):
            read_settings(source(tmp_path))


def test_all_misfits_are_named_in_one_error() -> None:
    public = tensors()
    del public["decoder.layers.1.norm2.bias"]
    public["decoder.layers.0.spatial_attn.qkv.bias"] = np.zeros(48, np.float32)
    public["out_x_proj.bias"] = np.zeros(3, np.float32)
    with pytest.raises(ConvertError) as caught:
        from_public(Path("file"), public, SETTINGS)
    message = str(caught.value)
    assert "missing: decoder.layers.1.norm2.bias" in message
    assert "unexpected: decoder.layers.0.spatial_attn.qkv.bias" in message
    assert "of another shape: out_x_proj.bias is (3,), not (16,)" in message


def test_tensors_of_something_else_are_refused() -> None:
    with pytest.raises(ConvertError, match="no weights of a Genie"):
        infer_config(Path("file"), {"encoder.conv_in.weight": np.zeros((4, 3, 3, 3))}, SETTINGS)


@pytest.mark.parametrize(
    "fields",
    [
        {"use_depth": True},
        {"departures": Departures(final_norm=True)},
        {"action_inputs": 7},
        {"departures": Departures(rotary=True)},
    ],
    ids=str,
)
def test_a_model_without_public_names_is_not_exported(fields: dict[str, Any]) -> None:
    config = Architecture(**{"width": 16, "blocks": 2, "heads": 2, "use_depth": False, "action_inputs": 0} | fields)
    params = jax.eval_shape(Transformer(config).init_params, jax.random.key(0))
    with pytest.raises(ConvertError, match="no name for these parts|cannot express model.departures.rotary"):
        to_tensors(params, table(config))
