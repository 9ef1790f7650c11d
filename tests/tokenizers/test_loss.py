from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rsjax.config import TokenizerConfig, TokenizerTrainConfig
from rsjax.tokenizers import lfq
from rsjax.tokenizers.adversarial import adversarial_terms, initial_averages
from rsjax.tokenizers.discriminator import Discriminator
from rsjax.tokenizers.loss import tokenizer_terms
from rsjax.tokenizers.lpips import lpips
from rsjax.tokenizers.magvit2 import Tokenizer
from tests.tokenizers.test_lpips import narrow

CONFIG = TokenizerConfig(image_size=8, channels=8, channel_multipliers=(1,), res_blocks=1, norm_groups=4, code_bits=4)


def test_terms_are_those_of_the_plain_computation_and_reach_both_halves() -> None:
    train = TokenizerTrainConfig()
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
        "entropy": lfq.entropy_loss(latents, train.entropy_temperature),
        "commitment": np.mean((latents - np.where(latents > 0, 1, -1)) ** 2),
    }

    def l1_and_all(p: Any) -> tuple[Any, Any]:
        terms = tokenizer_terms(CONFIG, train, p, jnp.array(images), jnp.int32(0))
        return terms["l1"][0], terms

    gradient, terms = jax.jit(jax.grad(l1_and_all, has_aux=True))(params)
    assert terms.keys() == train.weights.keys() == expected.keys()
    for name, (total, weight) in terms.items():
        assert weight == 3
        np.testing.assert_allclose(total / weight, expected[name], rtol=1e-5, atol=1e-6, err_msg=name)

    assert np.any(gradient["encoder"]["conv_in"]["kernel"])
    assert np.any(gradient["decoder"]["conv_in"]["kernel"])


def test_the_whole_loss_is_the_sum_of_its_parts() -> None:
    """The judging networks see the tokenizer's images as they are, and the names are those of the weights."""
    config = replace(CONFIG, image_size=32, patch_size=4)
    train = TokenizerTrainConfig(perceptual=1.0, lpips_weights="given below", adversarial=0.1, disc_start=3)
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
        judged = (train, params["discriminator"], target, output, jnp.float32(1), extra["lecam"], None)
        terms = tokenizer_terms(config, train, params, jnp.array(images), jnp.int32(3), extra)
        plain = tokenizer_terms(config, TokenizerTrainConfig(), params["generator"], jnp.array(images), jnp.int32(0))
        return terms, plain | expected | adversarial_terms(*judged)

    terms, expected = both(params)
    assert terms.keys() == train.weights.keys()
    assert train.weights["real_logit"] == train.weights["fake_logit"] == 0
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5), terms, expected)


def test_lpips_without_weights_is_off_and_says_so() -> None:
    train = TokenizerTrainConfig(perceptual=1.0)
    assert train.lpips_missing
    assert "perceptual" not in train.weights
    with_weights = replace(train, lpips_weights="somewhere")
    assert not with_weights.lpips_missing
    assert with_weights.weights["perceptual"] == 1.0
    assert not TokenizerTrainConfig().lpips_missing
