"""Floating-point operations of autoencoders: the tokenizer's by a formula, the others' from the traced program.

The formula counts 2 per weight of a kernel and output position. Norms, activations and the quantiser are left out.
Convolutions count padding like pixels, as libraries do.
"""

import math
import re
from collections.abc import Callable
from typing import Any

import jax
from flax.traverse_util import flatten_dict
from jax.extend.core import jaxprs_in_params

from rsjax.config import TokenizerConfig
from rsjax.layers.platform import for_all_platforms
from rsjax.tokenizers.magvit2 import Tokenizer
from rsjax.trainable import Params


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
    if module == at_full_size:
        return size**2
    return config.grid(image_size) ** 2


def traced_flops(
    params: Params, frames: tuple[int, ...], encode: Callable[..., Any], decode: Callable[..., Any]
) -> dict[str, int]:
    """Returns the operations of both halves of any autoencoder, the "encoder" and the "decoder".

    Args:
        params: the parameters' shapes.
        frames: the shape of the frames to encode, float32.
        encode: from parameters and frames to latents or tokens.
        decode: from parameters and what ``encode`` returns to frames.
    """
    pixels = jax.ShapeDtypeStruct(frames, "float32")
    halves = {"encoder": (encode, pixels), "decoder": (decode, jax.eval_shape(encode, params, pixels))}
    with for_all_platforms():  # the count is the same wherever it is made
        return {name: products(jax.make_jaxpr(run)(params, x).jaxpr) for name, (run, x) in halves.items()}


def products(jaxpr: Any) -> int:
    """Returns the operations of the products and convolutions in a program.

    A scan's count once per iteration. Of branches one counts, that with the most: a program runs one of them, such as
    the implementation for its platform.
    """
    total = 0
    for eqn in jaxpr.eqns:
        if eqn.primitive.name == "dot_general":
            (contracted, _), _ = eqn.params["dimension_numbers"]
            total += 2 * eqn.outvars[0].aval.size * math.prod(eqn.invars[0].aval.shape[i] for i in contracted)
        elif eqn.primitive.name == "conv_general_dilated":
            kernel = eqn.invars[1].aval
            spec = eqn.params["dimension_numbers"].rhs_spec
            total += 2 * eqn.outvars[0].aval.size * kernel.size // kernel.shape[spec[0]]
        if eqn.primitive.name == "cond":
            total += max(products(branch.jaxpr) for branch in eqn.params["branches"])
            continue
        turns = 1
        if eqn.primitive.name == "scan":
            turns = eqn.params["length"]
        total += turns * sum(products(inner) for inner in jaxprs_in_params(eqn.params))
    return total
