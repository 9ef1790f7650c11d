"""iVideoGPT's settings, counts of operations, and weights to start from."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import Config, ConfigError, to_dict
from rsjax.config.config_fields import with_values
from rsjax.errors import UserError
from rsjax.models.ivideogpt.autoencoder import ConditionalVQTraining
from rsjax.models.ivideogpt.config import IVideoGPTConfig, TopKConfig
from rsjax.models.ivideogpt.llama import LLaMA
from rsjax.models.ivideogpt.model import IVideoGPT
from rsjax.tokenizers.flops import products
from tests.models import families
from tests.models.ivideogpt.toy import random_params


@pytest.fixture(scope="module")
def config() -> Config:
    return families.ivideogpt()


def test_operations_by_formula_are_those_of_the_traced_program(config: Config) -> None:
    assert isinstance(config.model, IVideoGPTConfig)
    model = IVideoGPT(replace(config.model, use_actions=False), config.clips)
    arch, frames = model.architecture, config.clips.frames
    tokens = jnp.zeros((1, arch.layout.length(frames) - 1), jnp.int32)
    network, skip = LLaMA(arch), arch.layout.first_slot
    params = jax.eval_shape(model.init, jax.random.key(0))
    traced = jax.make_jaxpr(lambda params: network.apply({"params": params}, tokens, None, skip=skip)[0])(params)
    assert products(traced.jaxpr) == model.flops(frames)["forward"]


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"model.positions": 80}, r"6 frames has 89 tokens, but model.positions is 80; raise it"),
        ({"model.autoencoder.context_frames": 6}, "6 frames, of which model.autoencoder.context_frames 6 are context"),
        ({"model.heads": 3}, "model.width 16 is not divisible by 2 × model.heads"),
    ],
)
def test_a_model_that_does_not_fit_the_clips_is_refused(config: Config, values: dict[str, int], line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        with_values(config, values)


def test_a_tokenizer_without_later_frames_is_refused(config: Config) -> None:
    with pytest.raises(ConfigError, match="frames_per_clip is 1; the tokenizer learns from .*context_frames 1 and"):
        ConditionalVQTraining.create(with_values(config, {"tokenizer_train.frames_per_clip": 1}))


def test_training_starts_from_more_context_or_without_actions(config: Config, tmp_path: Path) -> None:
    own, model = ConditionalVQTraining.create(config), IVideoGPT.create(config)
    for part in ("tokenizer", "world_model"):
        (tmp_path / part / "weights").mkdir(parents=True)
    saved_by(tmp_path, model.config, 64, config.clips.action_dim)
    shapes = own.pretrained_shapes(tmp_path)
    assert jax.tree.map(lambda x: x.shape, shapes) == jax.tree.map(lambda x: x.shape, own.shapes())
    wide = replace(own, config=replace(own.config, context_frames=2))
    wider = IVideoGPT(replace(model.config, width=32, sample=TopKConfig(seed=1)), model.clips)
    fewer = IVideoGPT(model.config, replace(model.clips, action_dim=5))
    for other, message in (
        (wide, "context_frames is 1 there, 2 here"),
        (replace(own, image_size=128), "its tokenizer is for images of 64 pixels, these have 128"),
        (wider, "another network .width is 16 there, 32 here"),
        (fewer, "reads actions of 28 numbers, this one of 5"),
    ):
        with pytest.raises(UserError, match=message):
            other.pretrained_shapes(tmp_path)  # type: ignore[attr-defined]
    saved, fresh = random_params(wide.shapes()), random_params(own.shapes())
    kept = own.start(fresh, saved, tmp_path)["cond_encoder"]["cross_0"]
    np.testing.assert_array_equal(kept["kv_pos_emb"], saved["cond_encoder"]["cross_0"]["kv_pos_emb"][64:])
    np.testing.assert_array_equal(kept["q_pos_emb"], saved["cond_encoder"]["cross_0"]["q_pos_emb"])
    assert model.pretrained_shapes(tmp_path)["action_linear"]["kernel"].shape == (config.clips.action_dim, 16)
    blind = replace(model, config=replace(model.config, use_actions=False))
    with_actions = random_params(blind.pretrained_shapes(tmp_path))
    begun = blind.start(jax.eval_shape(blind.init, jax.random.key(0)), with_actions, tmp_path)
    assert with_actions.keys() - begun.keys() == {"action_linear"}
    saved_by(tmp_path, replace(model.config, use_actions=False), 64, 0)
    assert "action_linear" not in fewer.pretrained_shapes(tmp_path)


def saved_by(directory: Path, model: IVideoGPTConfig, size: int, actions: int) -> None:
    """Writes the settings that ``rsjax convert`` would."""
    inputs = {"image_size": size, "action_dim": actions}
    (directory / "config.json").write_text(json.dumps({"model": to_dict(model), "inputs": inputs}))
