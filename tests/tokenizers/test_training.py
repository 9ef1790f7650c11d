from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import AdversarialConfig, ConfigError, PerceptualConfig, TokenizerConfig, TokenizerTrainConfig
from rsjax.errors import UserError
from rsjax.tokenizers import lfq
from rsjax.tokenizers.adversarial import adversarial_terms, initial_averages
from rsjax.tokenizers.discriminator import MIN_SIZE, Discriminator
from rsjax.tokenizers.lpips import lpips
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tokenizers.training import ENTROPY_TEMPERATURE, TokenizerTraining
from rsjax.tools.convert.directory import save
from rsjax.trainable import StepContext
from rsjax.training.checkpoint import load_weights
from tests.tokenizers.test_lpips import narrow

CONFIG = TokenizerConfig(channels=8, channel_multipliers=(1,), res_blocks=1, norm_groups=4, code_bits=4)


def test_terms_are_those_of_the_plain_computation_and_reach_both_halves() -> None:
    train = TokenizerTrainConfig()
    training = TokenizerTraining(CONFIG, train, 8)
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(Tokenizer(CONFIG).init_params, jax.random.key(0))
    params = jax.tree.map(lambda x: rng.normal(scale=0.2, size=x.shape).astype(np.float32), shapes)
    images = rng.integers(0, 256, (3, 8, 8, 3), np.uint8)
    target = images / np.float32(127.5) - 1
    output, latents = jax.jit(Tokenizer(CONFIG).apply)({"params": params}, target)
    error = target - np.asarray(output)
    expected = {
        "l1": np.mean(np.abs(error)),
        "l2": np.mean(error**2),
        "entropy": lfq.entropy_loss(latents, ENTROPY_TEMPERATURE),
        "commitment": np.mean((latents - np.where(latents > 0, 1, -1)) ** 2),
    }

    def l1_and_all(p: Any) -> tuple[Any, Any]:
        context = StepContext(jnp.int32(0), None, None)
        terms = training.loss_terms(p, jnp.array(images), jax.random.key(0), context)
        return terms["l1"][0], terms

    gradient, terms = jax.jit(jax.grad(l1_and_all, has_aux=True))(params)
    assert terms.keys() == training.loss_weights.keys() == expected.keys()
    for name, (total, weight) in terms.items():
        assert weight == 3
        np.testing.assert_allclose(total / weight, expected[name], rtol=1e-5, atol=1e-6, err_msg=name)

    assert np.any(gradient["encoder"]["conv_in"]["kernel"])
    assert np.any(gradient["decoder"]["conv_in"]["kernel"])


def test_the_entropy_is_the_mean_over_groups_of_images() -> None:
    latents = jax.random.normal(jax.random.key(0), (6, 2, 2, 4)) * 0.01
    train = TokenizerTrainConfig(batch_size=6, frames_per_clip=1, entropy_group=2)
    grouped = TokenizerTraining(CONFIG, train, 8).entropy(latents, None)
    groups = [lfq.entropy_loss(latents[i : i + 2], 0.01) for i in (0, 2, 4)]
    np.testing.assert_allclose(grouped, np.mean(groups), rtol=1e-5)
    assert abs(grouped - lfq.entropy_loss(latents, 0.01)) > 0.01
    with pytest.raises(ConfigError, match=r"entropy_group is 2, but a device computes 3 images"):
        TokenizerTraining(CONFIG, train, 8).entropy(latents[:3], None)
    with pytest.raises(ConfigError, match=r"entropy_group is 4; it must divide the 6 images"):
        replace(train, entropy_group=4)


def test_the_whole_loss_is_the_sum_of_its_parts() -> None:
    """The judging networks see the tokenizer's images as they are, and the names are those of the weights."""
    config = replace(CONFIG, patch_size=4)
    adversarial = AdversarialConfig(start=3)
    train = TokenizerTrainConfig(perceptual=PerceptualConfig(lpips="not read here"), adversarial=adversarial)
    rng = np.random.default_rng(0)
    inits = {"generator": Tokenizer(config).init_params, "discriminator": Discriminator().init_params}
    shapes = {name: jax.eval_shape(init, jax.random.key(0)) for name, init in inits.items()}
    params = jax.tree.map(lambda x: rng.normal(scale=0.1, size=x.shape).astype(np.float32), shapes)
    extra = {"lpips": narrow("vgg16"), "lecam": initial_averages()}
    images = rng.integers(0, 256, (2, 32, 32, 3), np.uint8)

    @jax.jit
    def both(params: Any) -> Any:
        target = images / jnp.float32(127.5) - 1
        output, _ = Tokenizer(config).apply({"params": params["generator"]}, target)
        expected = {"perceptual": (2 * jnp.mean(lpips(extra["lpips"], target, output)), jnp.float32(2))}
        judged = (adversarial, params["discriminator"], target, output, jnp.float32(1), extra["lecam"], None)

        def terms_of(train: TokenizerTrainConfig, params: Any, step: int, extra: Any) -> Any:
            context = StepContext(jnp.int32(step), extra, None)
            model = TokenizerTraining(config, train, images.shape[1])
            return model.loss_terms(params, jnp.array(images), jax.random.key(0), context)

        terms = terms_of(train, params, 3, extra)
        plain = terms_of(TokenizerTrainConfig(), params["generator"], 0, None)
        return terms, plain | expected | adversarial_terms(*judged)

    terms, expected = both(params)
    assert terms.keys() == train.loss_weights.keys()
    assert train.loss_weights["real_logit"] == train.loss_weights["fake_logit"] == 0
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5), terms, expected)


def test_lpips_without_weights_is_off_and_says_so() -> None:
    train = TokenizerTrainConfig(perceptual=PerceptualConfig())
    assert train.lpips_missing
    assert "perceptual" not in train.loss_weights
    with_weights = replace(train, perceptual=PerceptualConfig(lpips="somewhere"))
    assert not with_weights.lpips_missing
    assert with_weights.loss_weights["perceptual"] == 1.0
    assert not TokenizerTrainConfig().lpips_missing


def test_images_too_small_for_the_discriminator_are_refused() -> None:
    train = TokenizerTrainConfig(adversarial=AdversarialConfig())
    with pytest.raises(ConfigError, match=f"images of 8 pixels; the discriminator needs at least {MIN_SIZE}"):
        TokenizerTraining(CONFIG, train, 8)
    TokenizerTraining(CONFIG, train, MIN_SIZE)
    TokenizerTraining(CONFIG, TokenizerTrainConfig(), 8)


def test_training_starts_from_a_saved_tokenizer_with_or_without_a_discriminator(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    training = TokenizerTraining(CONFIG, TokenizerTrainConfig(), 8)
    fresh = jax.jit(training.init)(jax.random.key(0))
    saved = jax.tree.map(lambda x: rng.normal(size=x.shape).astype(np.float32), fresh)
    save(tmp_path, CONFIG, saved)
    loaded = load_weights(tmp_path / "tokenizer" / "weights", training.pretrained_shapes(tmp_path))
    jax.tree.map(np.testing.assert_array_equal, training.start(fresh, loaded, tmp_path), saved)
    judge = {"main_0": np.ones(3)}
    begun = training.start({"generator": fresh, "discriminator": judge}, loaded, tmp_path)
    jax.tree.map(np.testing.assert_array_equal, begun, {"generator": saved, "discriminator": judge})
    other = replace(training, tokenizer=replace(CONFIG, norm_groups=8))
    with pytest.raises(UserError, match="norm_groups is 4 there, 8 here"):
        other.pretrained_shapes(tmp_path)
    free = replace(training, tokenizer=replace(CONFIG, vocabularies=1, depth_scale="linear"))
    assert jax.tree.map(jnp.shape, free.pretrained_shapes(tmp_path)) == jax.tree.map(jnp.shape, fresh)
    with pytest.raises(UserError, match="holds no tokenizer/weights with their settings"):
        training.pretrained_shapes(tmp_path / "empty")
