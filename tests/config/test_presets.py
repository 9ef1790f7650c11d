"""The named experiments are the sizes that they claim to be."""

from dataclasses import replace

import jax
import pytest

from rsjax.config import DepthHead, GenieConfig, RoboScapeConfig, presets
from rsjax.models.base import create_model
from rsjax.models.roboscape.architecture import Architecture
from rsjax.tools.describe import by_part, count

SMALL = ("debug", "tiny", "tiny_policies", "multitask")
WORLD_MODELS = {  # (RGB branch with what it shares, all)
    "genie_35m": (35_218_688, 35_218_688),  # published
    "genie_138m": (137_545_216, 137_545_216),  # published
    "genie_35m_actions": (35_291_904, 35_291_904),
    "roboscape_s": (35_226_112, 71_501_568),
    "roboscape_m": (137_560_064, 281_413_120),
    "roboscape_l": (543_554_560, 1_116_472_320),
    "roboscape_physics_s": (35_226_112, 35_751_680),
    "roboscape_physics_m": (137_560_064, 138_610_176),
    "roboscape_physics_l": (543_554_560, 545_653_760),
}


@pytest.mark.parametrize(("name", "published"), [("roboscape_s", 268), ("roboscape_m", 537), ("roboscape_l", 1074)])
def test_the_cache_of_a_rollout_in_bf16_has_the_known_size(name: str, published: int) -> None:
    assert round(2 * count(create_model(presets.get(name)).cache_shapes(16)) / 1e6) == published


@pytest.mark.parametrize("name", WORLD_MODELS)
def test_full_size_presets_are_the_papers_setting_with_their_exact_counts(name: str) -> None:
    config = presets.get(name)
    network = Architecture.create(config)
    assert (config.clips.image_size, network.grid, network.code_bits) == (256, 16, 18)
    assert (network.frames, network.blocks) == (16, 32)
    roboscape = name.startswith("roboscape")
    assert isinstance(config.model, RoboScapeConfig if roboscape else GenieConfig)
    assert config.model.uses_depth == roboscape
    assert (network.action_inputs > 0) == (roboscape or name.endswith("actions"))
    if name.startswith("roboscape_physics"):
        paper = presets.get(name.replace("_physics", "")).model
        assert isinstance(paper, RoboScapeConfig)
        assert config.model == replace(paper, depth=DepthHead(), loss=replace(paper.loss, keypoints="none"))
    else:
        assert network.depth == ("branch" if roboscape else "none")
    parts = by_part(jax.eval_shape(create_model(config).init, jax.random.key(0)))
    assert (count(parts["rgb"]) + count(parts["shared"]), count(parts)) == WORLD_MODELS[name]


def test_full_size_presets_of_every_family_are_scored_alike() -> None:
    full_size = [each for name, each in presets.PRESETS.items() if not name.endswith(SMALL)]
    assert {each.model.family for each in full_size} == {"roboscape", "genie", "ivideogpt", "irasim", "cogvideox"}
    assert {(each.eval.clips, each.eval.repetitions) for each in full_size} == {(1200, 5)}


def test_the_public_genie_has_heads_of_32_and_64() -> None:
    networks = [Architecture.create(presets.get(name)) for name in ("genie_35m", "genie_138m")]
    assert [network.head_width for network in networks] == [32, 64]


@pytest.mark.parametrize("name", ["ivideogpt_64", "ivideogpt_256"])
def test_the_public_tokenizer_of_ivideogpt_has_half_of_its_counters_steps(name: str) -> None:
    config = presets.get(name)
    assert (config.tokenizer_train.steps, config.train.steps) == (100_000, 100_000)
