"""Convolution layers with float32 parameters and, if wanted, bf16 operands."""

from functools import partial
from typing import Any, Literal

import flax.linen as nn
import jax
from jaxtyping import Array, Float

from rsjax.layers.parameters import parameter
from rsjax.layers.platform import convolve

Dtype = Literal["float32", "bfloat16"]


class Conv(nn.Module):
    """A convolution with a square kernel and float32 parameters; its output has the number format of its input.

    Parameters have the names, shapes and initial values of flax's layer;
    :func:`rsjax.layers.platform.with_transformed_kernels` may add one.
    """

    features: int
    size: int
    bf16: bool
    stride: int = 1
    padding: Any = "SAME"
    use_bias: bool = True

    @nn.compact
    def __call__(self, x: Float[Array, "B h w C"]) -> Float[Array, "B h w D"]:
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = parameter(self, "kernel", nn.initializers.lecun_normal(), shape)
        run = jax.lax.conv_general_dilated
        if self.bf16:
            run = partial(convolve, transformed=self.get_variable("params", "transformed"))
        strides = (self.stride, self.stride)
        out = run(x, kernel, strides, self.padding, dimension_numbers=("NHWC", "HWIO", "NHWC"))
        if self.use_bias:
            out = out + parameter(self, "bias", nn.initializers.zeros, (self.features,))
        return out.astype(x.dtype)


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
    return Conv(features, kernel, dtype == "bfloat16", stride, padding, use_bias, name=name)
