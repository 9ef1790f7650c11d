"""Operations by formula are those of the traced program."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

from rsjax.config import TokenizerConfig
from rsjax.tokenizers.flops import tokenizer_flops
from rsjax.tokenizers.magvit2 import Tokenizer
from tests.tracing import products

SIZE = 32
PATCHED = TokenizerConfig(
    patch_size=2, channels=8, channel_multipliers=(1, 2, 2), res_blocks=2, norm_groups=4, code_bits=6
)


@pytest.mark.parametrize(
    "config", [PATCHED, replace(PATCHED, patch_size=1, adaptive_norm=True)], ids=["patched", "adaptive"]
)
def test_the_tokenizers_halves_are_the_formula_to_the_letter(config: TokenizerConfig) -> None:
    params = jax.eval_shape(Tokenizer(config).init_params, jax.random.key(0))
    images = jnp.zeros((1, SIZE, SIZE, 3))
    tokens = jnp.zeros((1, config.grid(SIZE), config.grid(SIZE)), jnp.int32)
    expected = tokenizer_flops(config, SIZE)
    for half, method, inputs in (("encoder", "encode", images), ("decoder", "decode", tokens)):
        run = lambda params, x, method=method: Tokenizer(config).apply({"params": params}, x, method=method)  # noqa: E731
        assert products(jax.make_jaxpr(run)(params, inputs).jaxpr) == expected[half]
