import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import LoopConfig, ModelConfig, TokenizerConfig
from rsjax.convert.genie import from_public
from rsjax.models.roboscape.world_model import WorldModel
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.training import pretrained as parts
from rsjax.training.pretrained import PartError, load_part, save_part, start_tokenizer, start_world_model
from tests.convert.public import genie_shapes, random_tensors
from tests.training.toy import train

ALONE = ModelConfig(frames=3, grid=2, code_bits=4, action_dim=0, width=8, blocks=2, heads=2, depth=False)
DUAL = replace(ALONE, depth=True, action_dim=5, action_dropout=0.1)
TOKENIZER = TokenizerConfig(
    image_size=16, patch_size=2, channels=8, channel_multipliers=(1, 2), res_blocks=1, norm_groups=4, code_bits=6
)


def random_params(init: Any, seed: int = 0) -> Any:
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(init, jax.random.key(0))
    return jax.tree.map(lambda x: rng.normal(scale=0.4, size=x.shape).astype(np.float32), shapes)


def rgb_logits(config: ModelConfig, params: Any) -> np.ndarray:
    rng = np.random.default_rng(0)
    shape = (2, config.frames, config.grid, config.grid)
    tokens, depth = (rng.integers(0, 2**config.code_bits, shape, np.int32) for _ in range(2))
    mask, actions = rng.random(shape) < 0.4, rng.normal(size=(2, config.frames, config.action_dim))
    given = {"rgb": tokens, "depth": depth} if config.depth else {"rgb": tokens}
    apply = jax.jit(lambda p, *x: WorldModel(config).apply({"params": p}, *x)[0]["rgb"])
    return np.asarray(apply(params, given, mask, actions.astype(np.float32)))


@pytest.fixture(scope="module")
def public(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a model without actions and a tokenizer."""
    directory = tmp_path_factory.mktemp("public")
    save_part(directory, ALONE, random_params(WorldModel(ALONE).init_params))
    save_part(directory, TOKENIZER, random_params(Tokenizer(TOKENIZER).init_params))
    return directory


def test_parts_come_back_as_they_were_saved(public: Path) -> None:
    for expected, init in ((ALONE, WorldModel(ALONE).init_params), (TOKENIZER, Tokenizer(TOKENIZER).init_params)):
        config, params = load_part(public, type(expected))
        assert config == expected
        jax.tree.map(np.testing.assert_array_equal, params, random_params(init))


@pytest.mark.parametrize(
    "options",
    [{}, {"qk_norm": True, "mup": True}, {"compute_dtype": "bfloat16"}],
    ids=["plain", "qk-norm and muP", "bfloat16"],
)
def test_a_dual_model_begins_with_the_very_logits_of_the_genie_it_starts_from(
    options: dict[str, Any], tmp_path: Path
) -> None:
    settings = {"num_heads": ALONE.heads, "use_mup": options.get("mup", False)}
    tensors = random_tensors(genie_shapes(2, 8, 2, 3, 4, 4, options.get("qk_norm", False)))
    config, params = from_public(Path("file"), tensors, settings)
    save_part(tmp_path, config, params)
    alone, dual = replace(config, **options), replace(DUAL, **options)
    # None of the fresh parameters is zero, so that what has to be is made so here.
    fresh = random_params(WorldModel(dual).init_params, seed=1)
    begun = start_world_model(dual, tmp_path, fresh)
    expected = rgb_logits(alone, params)
    np.testing.assert_array_equal(rgb_logits(dual, begun), expected)
    assert expected.std() > 0.1
    assert jax.tree.map(jnp.shape, begun) == jax.tree.map(jnp.shape, fresh)
    for path in ("depth_embed", "depth_head"):
        jax.tree.map(np.testing.assert_array_equal, begun[path], fresh[path])
    jax.tree.map(np.testing.assert_array_equal, begun["blocks"]["depth"], fresh["blocks"]["depth"])


def test_a_dual_model_starts_from_a_dual_model_to_the_letter(tmp_path: Path) -> None:
    saved = random_params(WorldModel(DUAL).init_params)
    save_part(tmp_path, DUAL, saved)
    begun = start_world_model(DUAL, tmp_path, random_params(WorldModel(DUAL).init_params, seed=1))
    jax.tree.map(np.testing.assert_array_equal, begun, saved)
    with pytest.raises(PartError, match="action_encoder/bias has no place in this model"):
        start_world_model(ALONE, tmp_path, random_params(WorldModel(ALONE).init_params))
    wider = replace(DUAL, action_dim=6)
    with pytest.raises(PartError, match=r"action_encoder/kernel is \(5, 8\), this model's is \(6, 8\)"):
        start_world_model(wider, tmp_path, random_params(WorldModel(wider).init_params))
    integrated = replace(DUAL, integrate_actions=True)
    with pytest.raises(PartError, match="integrate_actions is False there, True here"):
        start_world_model(integrated, tmp_path, saved)


def test_a_model_without_actions_leaves_open_what_its_successor_sees(public: Path) -> None:
    integrated = replace(DUAL, integrate_actions=True)
    fresh = random_params(WorldModel(integrated).init_params)
    assert not np.any(start_world_model(integrated, public, fresh)["action_encoder"]["kernel"])


@pytest.mark.parametrize(("field", "value"), [("heads", 4), ("mup", True), ("blocks", 3), ("frames", 5)])
def test_another_network_is_refused_even_where_the_shapes_agree(public: Path, field: str, value: Any) -> None:
    other = replace(DUAL, **{field: value})
    with pytest.raises(PartError, match=f"{field} is {getattr(DUAL, field)} there, {value} here"):
        start_world_model(other, public, random_params(WorldModel(other).init_params))


def test_a_tokenizer_starts_with_or_without_a_discriminator(public: Path) -> None:
    saved = load_part(public, TokenizerConfig)[1]
    fresh = random_params(Tokenizer(TOKENIZER).init_params, seed=1)
    jax.tree.map(np.testing.assert_array_equal, start_tokenizer(TOKENIZER, public, fresh), saved)
    judge = {"main_0": np.ones(3)}
    begun = start_tokenizer(TOKENIZER, public, {"generator": fresh, "discriminator": judge})
    jax.tree.map(np.testing.assert_array_equal, begun, {"generator": saved, "discriminator": judge})
    with pytest.raises(PartError, match="norm_groups is 4 there, 8 here"):
        start_tokenizer(replace(TOKENIZER, norm_groups=8), public, fresh)


def test_what_is_missing_or_damaged_is_named(tmp_path: Path) -> None:
    with pytest.raises(PartError, match="config.json: cannot be read"):
        load_part(tmp_path, ModelConfig)
    for text in ("{", "[]", json.dumps({"tokenizer": {}})):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(PartError, match=str(tmp_path)):
            load_part(tmp_path, ModelConfig)


@pytest.mark.parametrize(
    ("section", "told"), [([], "fields by name"), ("x", "fields by name"), ({"odd": 3}, "no field odd")]
)
def test_settings_that_are_none_are_refused_beside_sound_weights(section: Any, told: str, tmp_path: Path) -> None:
    save_part(tmp_path, TOKENIZER, random_params(Tokenizer(TOKENIZER).init_params))
    (tmp_path / "config.json").write_text(json.dumps({"tokenizer": section}))
    with pytest.raises(PartError, match=f"config.json: tokenizer cannot be read .*{told}"):
        load_part(tmp_path, TokenizerConfig)


def test_a_part_whose_replacement_stopped_half_way_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tokenizer = random_params(Tokenizer(TOKENIZER).init_params)
    save_part(tmp_path, TOKENIZER, tokenizer)
    save_part(tmp_path, ALONE, random_params(WorldModel(ALONE).init_params))

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(parts, "save_weights", stop)
    with pytest.raises(KeyboardInterrupt):
        save_part(tmp_path, replace(ALONE, heads=4), {})
    with pytest.raises(PartError, match="holds no world_model/weights with its settings"):
        load_part(tmp_path, ModelConfig)
    jax.tree.map(np.testing.assert_array_equal, load_part(tmp_path, TokenizerConfig)[1], tokenizer)


def test_training_begins_with_the_start_and_resumes_without_it(tmp_path: Path) -> None:
    loop = LoopConfig(steps=2, batch_size=2, ema=0.5, log_every=2, checkpoint_every=2)
    given = lambda fresh: jax.tree.map(lambda x: jnp.full_like(x, 7.0), fresh)  # noqa: E731
    still = replace(loop, steps=0, start_from="somewhere")
    state = train(still, tmp_path / "still", start=given)
    assert all(np.all(x == 7.0) for x in jax.tree.leaves((state.params, state.weights)))

    def never(fresh: Any) -> Any:
        raise AssertionError("there was a checkpoint")

    stopped = train(loop, tmp_path / "run", start=given, stop_at=1)
    assert all(x.min() > 6.0 and x.max() < 8.0 for x in jax.tree.leaves(stopped.params))
    assert train(loop, tmp_path / "run", start=never).step == 2
