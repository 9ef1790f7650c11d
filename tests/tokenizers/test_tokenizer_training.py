"""The training state of a tokenizer, and a step of it, with and without the networks that judge its images."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
import pytest
from safetensors.numpy import load_file, save_file

from rsjax.config import (
    AdversarialConfig,
    ConfigError,
    LoopConfig,
    PerceptualConfig,
    TokenizerConfig,
    TokenizerTrainConfig,
)
from rsjax.tokenizers.lpips import LpipsError, lpips_shapes
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tokenizers.training import TokenizerTraining
from rsjax.training.checkpoint import Checkpoints
from rsjax.training.state import TrainState, create_state
from rsjax.training.step import train_step
from tests.training.toy import QUICK

CONFIG = TokenizerConfig(patch_size=4, channels=8, channel_multipliers=(1,), res_blocks=1, norm_groups=4, code_bits=4)
PLAIN = TokenizerTrainConfig(steps=4, ema=0.9)
SIZE = 32
IMAGES = np.random.default_rng(0).integers(0, 256, (2, SIZE, SIZE, 3), np.uint8)


def assert_same(one: Any, other: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.fixture(scope="module")
def lpips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of random weights."""
    rng = np.random.default_rng(0)
    path = tmp_path_factory.mktemp("lpips") / "alexnet.safetensors"
    shapes = lpips_shapes("alexnet").items()
    tensors = {name: np.abs(rng.normal(scale=np.prod(size[1:]) ** -0.5, size=size)) for name, size in shapes}
    tensors |= {name: x - x.mean() for name, x in tensors.items() if name.startswith("backbone")}
    save_file({name: x.astype(np.float32) for name, x in tensors.items()}, path, metadata={"net": "alexnet"})
    return path


@pytest.fixture(scope="module")
def training(lpips: Path) -> TokenizerTraining:
    perceptual = PerceptualConfig(lpips=str(lpips))
    train = replace(PLAIN, adversarial=AdversarialConfig(lecam_decay=0.5), perceptual=perceptual)
    return TokenizerTraining(CONFIG, train, SIZE)


def fresh(training: TokenizerTraining) -> TrainState:
    """The state before the first step."""
    return jax.jit(partial(create_state, training, LoopConfig.create(training.train)))()


@pytest.fixture(scope="module")
def start(training: TokenizerTraining) -> TrainState:
    return fresh(training)


@pytest.fixture(scope="module")
def stepped(training: TokenizerTraining, start: TrainState) -> tuple[TrainState, dict[str, Any]]:
    step = jax.jit(partial(train_step, training, LoopConfig.create(training.train)), compiler_options=QUICK)
    return step(start, IMAGES)


def test_without_a_discriminator_the_parameters_are_the_tokenizers_alone() -> None:
    training = TokenizerTraining(CONFIG, PLAIN, SIZE)
    state = jax.eval_shape(partial(create_state, training, LoopConfig.create(PLAIN)))
    assert state.extra is None
    assert state.params == jax.eval_shape(Tokenizer(CONFIG).init_params, jax.random.key(0))
    assert training.tokenizer_params(state.params) is state.params


def test_with_a_discriminator_the_state_has_both_networks_and_the_tokenizer_can_be_taken_out(
    training: TokenizerTraining, start: TrainState
) -> None:
    assert start.params.keys() == {"generator", "discriminator"}
    assert training.tokenizer_params(start.params) is start.params["generator"]
    assert_same(start.params["generator"], fresh(TokenizerTraining(CONFIG, PLAIN, SIZE)).params)
    assert start.extra is not None and start.extra.keys() == {"lecam", "lpips"}


def test_one_step_trains_both_networks_and_moves_the_averages_and_not_the_weights_of_lpips(
    training: TokenizerTraining, start: TrainState, stepped: tuple[TrainState, dict[str, Any]]
) -> None:
    state, metrics = stepped
    moments = optax.tree_utils.tree_get(state.opt_state, "mu")
    assert all(np.any(x != 0) for x in jax.tree.leaves(moments))  # every parameter has a gradient
    assert start.extra is not None and state.extra is not None
    for name in ("real", "fake"):
        np.testing.assert_allclose(state.extra["lecam"][name], 0.5 * metrics[f"{name}_logit"], rtol=1e-5)
    assert_same(state.extra["lpips"], start.extra["lpips"])
    assert metrics["perceptual"] > 0
    weighted = [weight * metrics[name] for name, weight in training.loss_weights.items()]
    np.testing.assert_allclose(metrics["loss"], sum(weighted), rtol=1e-4)


def test_the_averages_and_lpips_are_saved_with_the_state(
    start: TrainState, stepped: tuple[TrainState, dict[str, Any]], tmp_path: Path
) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, stepped[0], {})
    restored, _ = checkpoints.restore(start)
    checkpoints.close()
    assert_same(restored, stepped[0])
    assert restored.extra is not None and restored.extra["lecam"]["real"] != 0


def test_the_weights_of_lpips_are_read_from_their_file(
    training: TokenizerTraining, lpips: Path, tmp_path: Path
) -> None:
    extra = training.init_extra()
    assert extra is not None
    np.testing.assert_array_equal(extra["lpips"]["head"]["4"]["weight"], load_file(lpips)["head.4.weight"])
    assert hash(training) == hash(replace(training))
    assert replace(training, train=replace(training.train, adversarial=None)).next_extra(extra, {}) is extra
    other = replace(PLAIN, perceptual=PerceptualConfig(lpips=str(tmp_path / "other")))
    with pytest.raises(LpipsError, match="no such LPIPS weights"):
        TokenizerTraining(CONFIG, other, 24).init_extra()
    with pytest.raises(ConfigError, match="images of 24 pixels; the LPIPS network of .* needs at least 31"):
        replace(training, image_size=24).init_extra()
