"""Floating-point operations of the tokenizer, counted from its kernels: 2 per weight and output position.

Norms, activations and the quantiser are left out. Convolutions count padding like pixels, as libraries do.
"""

import math
import re

import jax
from flax.traverse_util import flatten_dict

from rsjax.config import TokenizerConfig
from rsjax.tokenizers.magvit2 import Tokenizer


def tokenizer_flops(config: TokenizerConfig, image_size: int) -> dict[str, int]:
    """Returns the operations for one image of the "encoder" and the "decoder"."""
    shapes = jax.eval_shape(Tokenizer(config).init_params, jax.random.key(0))
    flops = {"encoder": 0, "decoder": 0}
    for (half, module, *rest), x in flatten_dict(shapes).items():
        if rest[-1] == "kernel":
            flops[half] += 2 * math.prod(x.shape) * _positions(config, image_size, half, module)
    return flops


def _positions(config: TokenizerConfig, image_size: int, half: str, module: str) -> int:
    """Returns the number of output positions of the module's convolutions."""
    size = image_size // config.patch_size
    if module.startswith("adaptive"):
        return 1  # linear layers on statistics of the whole image
    if level := re.match(r"(down|up)_(\d+)_", module):
        return (size // 2 ** (int(level[2]) + module.endswith("downsample"))) ** 2
    at_full_size = {"encoder": "conv_in", "decoder": "conv_out"}[half]
    return size**2 if module == at_full_size else config.grid(image_size) ** 2
