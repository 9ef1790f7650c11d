"""Operations by formula are those of the traced program."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import Config, TokenizerConfig
from rsjax.models.base import create_autoencoder
from rsjax.models.irasim.config import KLConfig
from rsjax.models.ivideogpt.conditional_vq import Codebook, CrossAttention
from rsjax.tokenizers.flops import products, tokenizer_flops
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.tokenizers.vae_blocks import SelfAttention
from rsjax.trainable import StepContext
from tests.models import families
from tests.tools.pipeline import toy

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


def sdxl() -> Config:
    base = families.irasim()
    network = KLConfig(channels=8, channel_multipliers=(1, 2), res_blocks=1, norm_groups=4)
    return replace(base, model=replace(base.model, autoencoder=network, patch_size=2))  # type: ignore[call-arg]


def of_layers(run: Callable[..., Any], *inputs: Any) -> int:
    """Counts the operations of all layers that are called: kernels at each position, attention, nearest codes."""
    total = 0

    def count(layer: Any, inputs: Any, options: Any, context: Any) -> Any:
        nonlocal total
        module, out = context.module, layer(*inputs, **options)
        if context.method_name == "nearest" and isinstance(module, Codebook):
            total += 2 * inputs[0].size * module.config.codes
        if context.method_name != "__call__":
            return out
        if isinstance(module, SelfAttention):
            images, rows, columns, width = out.shape
            total += 4 * images * (rows * columns) ** 2 * width
        if isinstance(module, CrossAttention):
            later, seen, width = out.size // out.shape[-1], inputs[1].size // inputs[1].shape[-1], out.shape[-1]
            total += 2 * (later + 2 * seen) * width**2 + 4 * later * seen * width  # of one clip
        if "kernel" in (params := module.variables.get("params", {})):
            total += 2 * params["kernel"].size * out.size // out.shape[-1]
        return out

    with nn.intercept_methods(count):
        jax.eval_shape(run, *inputs)
    return total


@pytest.mark.parametrize("make", [families.ivideogpt, families.irasim, sdxl, families.cogvideox])
def test_a_familys_autoencoder_counts_the_layers_that_its_loss_calls(make: Callable[[], Config]) -> None:
    config = make()
    autoencoder, frames = create_autoencoder(config), config.tokenizer_train.frames_per_clip
    clip = autoencoder.transform()({"rgb": toy.clip(0).rgb, "depth": None}, np.random.default_rng(0))
    batch = autoencoder.batch({name: x[None] for name, x in clip.items()} | {"index": np.arange(1)})
    context = StepContext(jnp.int32(0), None, None)
    of_clip = of_layers(
        lambda params: autoencoder.loss_terms(params, batch, jax.random.key(0), context), autoencoder.shapes()
    )
    halves = autoencoder.flops()
    assert 0 < halves["encoder"] < of_clip / frames
    assert 0 <= of_clip - frames * sum(halves.values()) < 2 * frames, "but for rounding to a frame's share"
