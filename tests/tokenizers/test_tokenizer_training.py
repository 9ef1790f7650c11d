"""The training state of a tokenizer, and a step of it, with and without the networks that judge its images."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
import pytest
from safetensors.numpy import save_file

from rsjax.config import (
    AdversarialConfig,
    ConfigError,
    LoopConfig,
    PerceptualConfig,
    TokenizerConfig,
    TokenizerTrainConfig,
)
from rsjax.tokenizers import training as module
from rsjax.tokenizers.lpips import LpipsError, lpips_shapes
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tokenizers.training import TokenizerTraining
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.state import TrainState, create_state
from rsjax.training.step import train_step
from tests.tokenizers.test_lpips import narrow
from tests.training.toy import QUICK

CONFIG = TokenizerConfig(patch_size=4, channels=8, channel_multipliers=(1,), res_blocks=1, norm_groups=4, code_bits=4)
PLAIN = TokenizerTrainConfig(steps=4, ema=0.9)
WHOLE = replace(PLAIN, adversarial=AdversarialConfig(lecam_decay=0.5), perceptual=PerceptualConfig())
IMAGES = np.random.default_rng(0).integers(0, 256, (2, 24, 24, 3), np.uint8)


def assert_same(one: Any, other: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.fixture(scope="module")
def training() -> TokenizerTraining:
    return TokenizerTraining(CONFIG, WHOLE, 24)


def fresh(training: TokenizerTraining) -> TrainState:
    """The state before the first step."""
    return jax.jit(partial(create_state, training, LoopConfig.create(training.train)))()


@pytest.fixture(scope="module")
def start(training: TokenizerTraining) -> TrainState:
    return fresh(training)


@pytest.fixture(scope="module")
def stepped(training: TokenizerTraining, start: TrainState) -> tuple[TrainState, dict[str, Any]]:
    return jax.jit(partial(train_step, training, LoopConfig.create(WHOLE)), compiler_options=QUICK)(start, IMAGES)


def test_without_a_discriminator_the_parameters_are_the_tokenizers_alone() -> None:
    training = TokenizerTraining(CONFIG, PLAIN, 24)
    state = jax.eval_shape(partial(create_state, training, LoopConfig.create(PLAIN)))
    assert state.extra is None
    assert state.params == jax.eval_shape(Tokenizer(CONFIG).init_params, jax.random.key(0))
    assert training.tokenizer_params(state.params) is state.params


def test_with_a_discriminator_the_state_has_both_networks_and_the_tokenizer_can_be_taken_out(
    training: TokenizerTraining, start: TrainState
) -> None:
    assert start.params.keys() == {"generator", "discriminator"}
    assert training.tokenizer_params(start.params) is start.params["generator"]
    assert_same(start.params["generator"], fresh(TokenizerTraining(CONFIG, PLAIN, 24)).params)
    assert start.extra is not None and start.extra.keys() == {"lecam"}


def test_one_step_trains_both_networks_and_moves_the_averages(
    training: TokenizerTraining, stepped: tuple[TrainState, dict[str, Any]]
) -> None:
    state, metrics = stepped
    moments = optax.tree_utils.tree_get(state.opt_state, "mu")
    assert all(np.any(x != 0) for x in jax.tree.leaves(moments))  # every parameter has a gradient
    assert state.extra is not None
    for name in ("real", "fake"):
        np.testing.assert_allclose(state.extra["lecam"][name], 0.5 * metrics[f"{name}_logit"], rtol=1e-5)
    weighted = [weight * metrics[name] for name, weight in training.loss_weights.items()]
    np.testing.assert_allclose(metrics["loss"], sum(weighted), rtol=1e-4)


def test_the_averages_are_saved_with_the_state(
    start: TrainState, stepped: tuple[TrainState, dict[str, Any]], tmp_path: Path
) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, stepped[0], {})
    restored, _ = checkpoints.restore(start)
    checkpoints.close()
    assert_same(restored, stepped[0])
    assert restored.extra is not None and restored.extra["lecam"]["real"] != 0


def test_the_weights_of_lpips_are_read_from_their_file_and_never_change(tmp_path: Path) -> None:
    tensors = {n: np.full(s, 0.01, np.float32) for n, s in lpips_shapes("alexnet").items()}
    path = tmp_path / "alexnet.safetensors"
    save_file(tensors, path, metadata={"net": "alexnet"})
    train = replace(PLAIN, perceptual=PerceptualConfig(lpips=str(path)))
    training = TokenizerTraining(CONFIG, train, 32)
    extra = training.init_extra()
    assert extra is not None
    np.testing.assert_array_equal(extra["lpips"]["head"]["4"]["weight"], tensors["head.4.weight"])
    assert training.next_extra(extra, {}) is extra
    assert hash(training) == hash(replace(training))
    other = replace(train, perceptual=PerceptualConfig(lpips=str(tmp_path / "other")))
    with pytest.raises(LpipsError, match="no such LPIPS weights"):
        TokenizerTraining(CONFIG, other, 24).init_extra()
    with pytest.raises(ConfigError, match="images of 24 pixels; the LPIPS network of .* needs at least 31"):
        TokenizerTraining(CONFIG, train, 24).init_extra()


def test_a_step_with_lpips_can_be_saved_and_restored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    weights = narrow("alexnet")
    monkeypatch.setattr(module, "load_lpips", lambda path: weights)
    training = TokenizerTraining(CONFIG, replace(PLAIN, perceptual=PerceptualConfig(lpips="narrow")), 32)
    images = np.random.default_rng(0).integers(0, 256, (1, 32, 32, 3), np.uint8)
    begun = fresh(training)
    stepped, metrics = jax.jit(
        partial(train_step, training, LoopConfig.create(training.train)), compiler_options=QUICK
    )(begun, images)
    assert metrics["perceptual"] > 0
    assert_same(stepped.extra, {"lpips": weights})
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, stepped, {})
    restored, _ = checkpoints.restore(begun)
    checkpoints.close()
    assert_same(restored, stepped)
