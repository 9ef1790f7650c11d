"""Convolution layers with float32 parameters and, if wanted, bf16 operands."""

from typing import Any, Literal

import flax.linen as nn

from rsjax.layers.platform import convolve

Dtype = Literal["float32", "bfloat16"]


def conv(
    features: int,
    kernel: int,
    dtype: Dtype,
    name: str | None = None,
    stride: int = 1,
    padding: Any = "SAME",
    use_bias: bool = True,
) -> nn.Conv:
    """Returns a convolution with a square kernel and float32 parameters, inputs and outputs.

    Args:
        dtype: bfloat16: operands are rounded to bf16 where this is faster, and products are added up in float32.
    """
    sizes = (kernel, kernel), (stride, stride)
    how = convolve if dtype == "bfloat16" else None
    return nn.Conv(features, *sizes, padding=padding, use_bias=use_bias, name=name, conv_general_dilated=how)
