from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
import pytest
from safetensors.numpy import save_file

from rsjax.config import ConfigError, TokenizerConfig, TokenizerTrainConfig
from rsjax.tokenizers.lpips import LpipsError, lpips_shapes
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.training import objectives
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.objectives import TokenizerObjective
from rsjax.training.state import TrainState, create_state
from rsjax.training.step import train_step
from tests.tokenizers.test_lpips import narrow

CONFIG = TokenizerConfig(
    image_size=24, patch_size=4, channels=8, channel_multipliers=(1,), res_blocks=1, norm_groups=4, code_bits=4
)
LARGER = replace(CONFIG, image_size=32)
PLAIN = TokenizerTrainConfig(steps=4, ema=0.9)
WHOLE = replace(PLAIN, adversarial=0.1, perceptual=1.0, lecam_decay=0.5)
IMAGES = np.random.default_rng(0).integers(0, 256, (2, 24, 24, 3), np.uint8)


def same(one: Any, other: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.fixture(scope="module")
def objective() -> TokenizerObjective:
    return TokenizerObjective(CONFIG, WHOLE)


def fresh(objective: TokenizerObjective) -> TrainState:
    """The state before the first step."""
    return jax.jit(partial(create_state, objective, objective.train))()


@pytest.fixture(scope="module")
def start(objective: TokenizerObjective) -> TrainState:
    return fresh(objective)


@pytest.fixture(scope="module")
def stepped(objective: TokenizerObjective, start: TrainState) -> tuple[TrainState, dict[str, Any]]:
    return jax.jit(partial(train_step, objective, WHOLE))(start, IMAGES)


def test_without_adversary_the_state_is_the_tokenizer_s_alone() -> None:
    objective = TokenizerObjective(CONFIG, PLAIN)
    state = jax.eval_shape(partial(create_state, objective, PLAIN))
    assert state.extra is None
    assert state.params == jax.eval_shape(Tokenizer(CONFIG).init_params, jax.random.key(0))
    assert objective.tokenizer_params(state.params) is state.params


def test_with_one_it_holds_both_and_gives_the_tokenizer_away(objective: TokenizerObjective, start: TrainState) -> None:
    assert start.params.keys() == {"generator", "discriminator"}
    assert objective.tokenizer_params(start.params) is start.params["generator"]
    same(start.params["generator"], fresh(TokenizerObjective(CONFIG, PLAIN)).params)
    assert start.extra.keys() == {"lecam"}


def test_one_step_teaches_both_networks_and_moves_the_averages(
    objective: TokenizerObjective, stepped: tuple[TrainState, dict[str, Any]]
) -> None:
    state, metrics = stepped
    moments = optax.tree_utils.tree_get(state.opt_state, "mu")
    assert all(np.any(x != 0) for x in jax.tree.leaves(moments))  # every parameter has a gradient
    for name in ("real", "fake"):
        np.testing.assert_allclose(state.extra["lecam"][name], 0.5 * metrics[f"{name}_logit"], rtol=1e-5)
    weighted = [weight * metrics[name] for name, weight in objective.weights.items()]
    np.testing.assert_allclose(metrics["loss"], sum(weighted), rtol=1e-4)


def test_the_averages_are_saved_with_the_state(
    start: TrainState, stepped: tuple[TrainState, dict[str, Any]], tmp_path: Path
) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, stepped[0], {})
    restored, _ = checkpoints.restore(start)
    checkpoints.close()
    same(restored, stepped[0])
    assert restored.extra["lecam"]["real"] != 0


def test_lpips_weights_ride_along_unchanged(tmp_path: Path) -> None:
    tensors = {n: np.full(s, 0.01, np.float32) for n, s in lpips_shapes("alexnet").items()}
    path = tmp_path / "alexnet.safetensors"
    save_file(tensors, path, metadata={"net": "alexnet"})
    objective = TokenizerObjective(LARGER, replace(PLAIN, perceptual=1.0, lpips_weights=str(path)))
    extra = objective.init_extra()
    np.testing.assert_array_equal(extra["lpips"]["head"]["4"]["weight"], tensors["head.4.weight"])
    assert objective.next_extra(extra, {}) is extra
    assert hash(objective) == hash(replace(objective))
    with pytest.raises(LpipsError, match="no such LPIPS weights"):
        TokenizerObjective(CONFIG, replace(PLAIN, perceptual=1.0, lpips_weights=str(tmp_path / "other"))).init_extra()
    small = TokenizerObjective(CONFIG, objective.train)
    with pytest.raises(ConfigError, match="tokenizer.image_size is 24; the LPIPS network of .* needs at least 31"):
        small.init_extra()


def test_a_step_with_lpips_survives_its_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    weights = narrow("alexnet")
    monkeypatch.setattr(objectives, "load_lpips", lambda path: weights)
    objective = TokenizerObjective(LARGER, replace(PLAIN, perceptual=1.0, lpips_weights="narrow"))
    images = np.random.default_rng(0).integers(0, 256, (1, 32, 32, 3), np.uint8)
    begun = fresh(objective)
    stepped, metrics = jax.jit(partial(train_step, objective, objective.train))(begun, images)
    assert metrics["perceptual"] > 0
    same(stepped.extra, {"lpips": weights})
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, stepped, {})
    restored, _ = checkpoints.restore(begun)
    checkpoints.close()
    same(restored, stepped)


def test_images_too_small_for_the_discriminator_are_refused() -> None:
    with pytest.raises(ConfigError, match="tokenizer.image_size is 16; the discriminator needs at least 24"):
        TokenizerObjective(replace(CONFIG, image_size=16), WHOLE)
    TokenizerObjective(replace(CONFIG, image_size=16), PLAIN)
