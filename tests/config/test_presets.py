"""The named experiments are the sizes that they claim to be."""

import jax
import pytest

from rsjax.config import presets
from rsjax.describe import by_part, cache_bytes, count
from rsjax.models.roboscape.world_model import WorldModel

WORLD_MODELS = {  # (RGB branch with what it shares, all)
    "genie_35m": (35_218_688, 35_218_688),  # published
    "genie_138m": (137_545_216, 137_545_216),  # published
    "roboscape_s": (35_226_112, 71_501_568),
    "roboscape_m": (137_560_064, 281_413_120),
    "roboscape_l": (543_554_560, 1_116_472_320),
}


@pytest.mark.parametrize("name", WORLD_MODELS)
def test_full_size_world_models_have_their_exact_counts(name: str) -> None:
    parts = by_part(jax.eval_shape(WorldModel(presets.get(name).model).init_params, jax.random.key(0)))
    alone = count(parts["rgb"]) + count(parts["shared"])
    assert (alone, count(parts)) == WORLD_MODELS[name]


@pytest.mark.parametrize(("name", "published"), [("roboscape_s", 268), ("roboscape_m", 537), ("roboscape_l", 1074)])
def test_the_cache_of_a_rollout_in_bf16_has_the_known_size(name: str, published: int) -> None:
    assert round(cache_bytes(presets.get(name).model, 2) / 1e6) == published


def test_full_size_presets_are_the_papers_setting() -> None:
    for name in WORLD_MODELS:
        config = presets.get(name)
        assert (config.tokenizer.image_size, config.model.grid, config.model.code_bits) == (256, 16, 18)
        assert (config.model.frames, config.model.blocks) == (16, 32)
        assert config.model.depth == name.startswith("roboscape")
        assert (config.model.action_dim > 0) == name.startswith("roboscape")


def test_the_public_genie_has_heads_of_32_and_64() -> None:
    assert [presets.get(name).model.head_width for name in ("genie_35m", "genie_138m")] == [32, 64]
