"""Floating-point operations of the tokenizer, counted from its kernels: 2 a weight and place where it is applied.

Norms, activations and the quantiser are left out, and so is the padding's share: a convolution counts as if every tap
met a pixel, as libraries count it.
"""

import math
import re

import jax
from flax.traverse_util import flatten_dict

from rsjax.config import TokenizerConfig
from rsjax.tokenizers.magvit2 import Tokenizer


def tokenizer_flops(config: TokenizerConfig) -> dict[str, int]:
    """Operations for one image, by half: "encoder", "decoder"."""
    shapes = jax.eval_shape(Tokenizer(config).init_params, jax.random.key(0))
    flops = {"encoder": 0, "decoder": 0}
    for (half, module, *rest), x in flatten_dict(shapes).items():
        if rest[-1] == "kernel":
            flops[half] += 2 * math.prod(x.shape) * _places(config, half, module)
    return flops


def _places(config: TokenizerConfig, half: str, module: str) -> int:
    """Places of the output of one of the module's convolutions."""
    size = config.image_size // config.patch_size
    if module.startswith("adaptive"):
        return 1  # linear layers on statistics of the whole image
    if level := re.match(r"(down|up)_(\d+)_", module):
        return (size // 2 ** (int(level[2]) + module.endswith("downsample"))) ** 2
    at_full_size = {"encoder": "conv_in", "decoder": "conv_out"}[half]
    return size**2 if module == at_full_size else config.grid**2
