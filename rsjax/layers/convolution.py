"""Convolution layers with float32 parameters and, if wanted, bf16 operands."""

from typing import Any, Literal

import flax.linen as nn
from jaxtyping import Array, Float

from rsjax.layers.platform import convolve

Dtype = Literal["float32", "bfloat16"]


class Conv(nn.Conv):
    """A convolution whose output has the number format of its input."""

    def __call__(self, inputs: Float[Array, "B h w C"]) -> Float[Array, "B h w D"]:
        return super().__call__(inputs).astype(inputs.dtype)


def conv(
    features: int,
    kernel: int,
    dtype: Dtype,
    name: str | None = None,
    stride: int = 1,
    padding: Any = "SAME",
    use_bias: bool = True,
) -> Conv:
    """Returns a convolution with a square kernel and float32 parameters.

    Args:
        dtype: bfloat16: operands are rounded to bf16 where this is faster, and products are added up in float32.
    """
    sizes = (kernel, kernel), (stride, stride)
    how = convolve if dtype == "bfloat16" else None
    return Conv(features, *sizes, padding=padding, use_bias=use_bias, name=name, conv_general_dilated=how)
