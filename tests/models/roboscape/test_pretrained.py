import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import GenieConfig, PublicCodeConfig, presets, to_dict
from rsjax.errors import UserError
from rsjax.models.roboscape import pretrained
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Transformer
from rsjax.tools.convert.directory import save
from rsjax.tools.convert.genie import from_public
from rsjax.training.checkpoint import load_weights, save_weights
from tests.models.roboscape.toy import depart, random_params
from tests.tools.convert.public import genie_shapes, random_tensors

ALONE = Architecture(frames=3, grid=2, code_bits=4, action_inputs=0, width=8, blocks=2, heads=2, depth="none")
BOTH = PublicCodeConfig(qk_norm=True, mup=True)
MUP = PublicCodeConfig(mup=True)
DUAL = depart(replace(ALONE, depth="branch", action_inputs=5), action_dropout=0.1)


def begin(own: Architecture, directory: Path, fresh: Any = None) -> Any:
    """The parameters that training of ``own`` begins with where ``train.start_from`` is the directory."""
    saved = load_weights(directory / "world_model" / "weights", pretrained.shapes(own, directory))
    return pretrained.start(random_params(own, seed=1) if fresh is None else fresh, saved, directory)


def rgb_logits(network: Architecture, params: Any) -> np.ndarray:
    rng = np.random.default_rng(0)
    shape = (2, network.frames, network.grid, network.grid)
    tokens, depth = (rng.integers(0, 2**network.code_bits, shape, np.int32) for _ in range(2))
    mask, actions = rng.random(shape) < 0.4, rng.normal(size=(2, network.frames, network.action_inputs))
    inputs = {"rgb": tokens, "depth": depth} if network.depth != "none" else {"rgb": tokens}
    apply = jax.jit(lambda p, *x: Transformer(network).apply({"params": p}, *x)[0]["rgb"])
    return np.asarray(apply(params, inputs, mask, actions.astype(np.float32)))


@pytest.fixture(scope="module")
def public(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a model without actions."""
    directory = tmp_path_factory.mktemp("public")
    save(directory, ALONE, random_params(ALONE))
    return directory


@pytest.mark.parametrize(
    ("depth", "options"),
    [
        ("branch", {"compute_dtype": "bfloat16"}),
        ("small branch", {"public_code": BOTH}),
        ("small branch", {"action_encoder": "norms"}),
        ("head", {"action_encoder": "mlp"}),
    ],
    ids=[
        "branch in bfloat16",
        "small branch with qk-norm and muP",
        "small branch with adaptive norms",
        "head with MLP",
    ],
)
def test_a_model_with_depth_begins_with_the_very_logits_of_the_genie_it_starts_from(
    depth: Any, options: dict[str, Any], tmp_path: Path
) -> None:
    settings = {"num_heads": ALONE.heads, "use_mup": "public_code" in options}
    tensors = random_tensors(genie_shapes(2, 8, 2, 3, 4, 4, "public_code" in options))
    config, params = from_public(Path("file"), tensors, settings)
    save(tmp_path, config, params)
    alone, dual = replace(config, **options), replace(DUAL, **options)
    if depth == "head":
        dual = replace(dual, depth="head")
    if depth == "small branch":
        dual = replace(dual, depth_width=4, depth_blocks=1)
    fresh = random_params(dual, seed=1)
    begun = begin(dual, tmp_path, fresh)
    expected = rgb_logits(alone, params)
    other_order = depth == "small branch" or "norms" in options.values()  # in which its program sums
    tolerance = 1e-4 * other_order
    np.testing.assert_allclose(rgb_logits(dual, begun), expected, rtol=tolerance, atol=tolerance)
    assert expected.std() > 0.1
    assert jax.tree.map(jnp.shape, begun) == jax.tree.map(jnp.shape, fresh)
    jax.tree.map(np.testing.assert_array_equal, begun["depth_head"], fresh["depth_head"])
    if depth == "head":
        assert not any(np.any(x) for x in jax.tree.leaves(begun["depth_embed"]))
        return
    jax.tree.map(np.testing.assert_array_equal, begun["depth_embed"], fresh["depth_embed"])
    jax.tree.map(np.testing.assert_array_equal, begun["blocks"]["depth"], fresh["blocks"]["depth"])


def test_a_dual_model_starts_from_a_dual_model_to_the_letter(tmp_path: Path) -> None:
    saved = random_params(DUAL)
    save(tmp_path, DUAL, saved)
    jax.tree.map(np.testing.assert_array_equal, begin(DUAL, tmp_path), saved)
    jax.tree.map(np.testing.assert_array_equal, begin(replace(DUAL, one_start=True), tmp_path), saved)
    (tmp_path / "empty").mkdir()
    for other, place, message in (
        (ALONE, tmp_path, "depth is branch there, none here"),
        (replace(DUAL, action_inputs=0), tmp_path, "action_encoder/bias has no place in this model"),
        (replace(DUAL, action_inputs=6), tmp_path, r"action_encoder/kernel is \(5, 8\), this model's is \(6, 8\)"),
        (depart(DUAL, integrate_actions=True), tmp_path, "integrate_actions is False there, True here"),
        (replace(DUAL, depth="head"), tmp_path, "depth is branch there, head here"),
        (replace(DUAL, action_encoder="mlp"), tmp_path, "action_encoder is linear there, mlp here"),
        (DUAL, tmp_path / "empty", "holds no world_model/weights with their settings"),
    ):
        with pytest.raises(UserError, match=message):
            begin(other, place)


@pytest.mark.parametrize("small", [{}, {"depth_width": 4, "depth_blocks": 1}], ids=["shared", "small branch"])
def test_null_actions_are_left_out_where_no_action_is_dropped(small: dict[str, Any], tmp_path: Path) -> None:
    dropping = replace(DUAL, **small)
    saved = random_params(dropping)
    save(tmp_path, dropping, saved)
    begun = begin(depart(dropping, action_dropout=0.0), tmp_path)
    nulls = saved.keys() - begun.keys()
    assert nulls == {"null_action"} | ({"depth_null_action"} if small else set())
    jax.tree.map(np.testing.assert_array_equal, begun, {name: saved[name] for name in begun})


def test_a_model_without_actions_leaves_open_what_its_successor_sees(public: Path) -> None:
    integrated = depart(DUAL, integrate_actions=True)
    assert not np.any(begin(integrated, public)["action_encoder"]["kernel"])


@pytest.mark.parametrize(("field", "value"), [("heads", 4), ("public_code", MUP), ("blocks", 3), ("frames", 5)])
def test_another_network_is_refused_even_where_the_shapes_agree(public: Path, field: str, value: Any) -> None:
    other = replace(DUAL, **{field: value})
    with pytest.raises(UserError) as caught:
        begin(other, public)
    assert f"{field} is {getattr(DUAL, field)} there, {value} here" in str(caught.value)


def test_a_run_is_such_a_directory_too(tmp_path: Path) -> None:
    """Its settings are the whole configuration, from which the network follows."""
    config = replace(presets.debug(), model=GenieConfig(width=8, blocks=1, heads=2, action_encoder="none"))
    genie = Architecture.create(config)
    (tmp_path / "world_model").mkdir()
    (tmp_path / "config.json").write_text(json.dumps(to_dict(config)))
    save_weights(tmp_path / "world_model" / "weights", random_params(genie))
    assert pretrained.read_architecture(tmp_path) == genie
    begun = begin(replace(genie, depth="branch", action_inputs=5, action_encoder="linear"), tmp_path)
    jax.tree.map(np.testing.assert_array_equal, begun["blocks"]["rgb"], random_params(genie)["blocks"]["rgb"])


def test_a_motion_head_begins_fresh_and_a_saved_one_is_left_out_where_there_is_none(tmp_path: Path) -> None:
    with_head = replace(DUAL, motion_head=True)
    save(tmp_path / "with", with_head, random_params(with_head))
    save(tmp_path / "without", DUAL, random_params(DUAL))
    assert "motion_head" not in begin(DUAL, tmp_path / "with")
    fresh = random_params(with_head, seed=1)
    begun = begin(with_head, tmp_path / "without", fresh)
    jax.tree.map(np.testing.assert_array_equal, begun["motion_head"], fresh["motion_head"])
    kept = begin(with_head, tmp_path / "with", fresh)
    jax.tree.map(np.testing.assert_array_equal, kept, random_params(with_head))
