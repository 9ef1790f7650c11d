from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rsjax.config import TokenizerConfig, TokenizerTrainConfig
from rsjax.tokenizer import lfq
from rsjax.tokenizer.loss import tokenizer_terms
from rsjax.tokenizer.magvit2 import Tokenizer

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
        terms = tokenizer_terms(CONFIG, train, p, jnp.array(images))
        return terms["l1"][0], terms

    gradient, terms = jax.jit(jax.grad(l1_and_all, has_aux=True))(params)
    assert terms.keys() == train.weights.keys() == expected.keys()
    for name, (total, weight) in terms.items():
        assert weight == 3
        np.testing.assert_allclose(total / weight, expected[name], rtol=1e-5, atol=1e-6, err_msg=name)

    assert np.any(gradient["encoder"]["conv_in"]["kernel"])
    assert np.any(gradient["decoder"]["conv_in"]["kernel"])
