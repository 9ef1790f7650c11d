"""What GPUs and TPUs compute where CPUs need something else; :mod:`rsjax.layers.platform` decides where it is used.

Axes: N rows, frames or sequences, S cells, h heads, e head width; B images, T frames, h×w cells, C and D channels,
i×j a kernel.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@jax.custom_vjp
def linear(x: Float[Array, "N K"], w: Float[Array, "K M"], bias: Float[Array, " M"] | None) -> Float[Array, "N M"]:
    """Returns x·w + bias in the number format of x: operands rounded to bf16, products added up in float32.

    The gradient is hand-written because the default one does not round cotangents, and adds those of the bias up in
    bf16. Gradients of weights and bias are float32. The bias is added in the format of x, which cuBLAS does in the
    product's own kernel.
    """
    out = _product(x, w, (1, 0), x.dtype)
    if bias is None:
        return out
    return out + bias.astype(x.dtype)


def _linear_forward(x: Array, w: Array, bias: Array | None) -> tuple[Array, tuple[Array, Array, Array | None]]:
    return linear(x, w, bias), (x.astype(jnp.bfloat16), w, bias)


def _linear_backward(saved: tuple[Array, Array, Array | None], cotangent: Array) -> tuple[Array, Array, Array | None]:
    x, w, bias = saved
    to_bias = None if bias is None else jnp.sum(cotangent.astype(jnp.float32), axis=0)
    return _product(cotangent, w, (1, 1), cotangent.dtype), _product(x, cotangent, (0, 0), jnp.float32), to_bias


def _product(x: Array, y: Array, contract: tuple[int, int], dtype: Any) -> Array:
    axes = (((contract[0],), (contract[1],)), ((), ()))
    return jax.lax.dot_general(x.astype(jnp.bfloat16), y.astype(jnp.bfloat16), axes, preferred_element_type=dtype)


linear.defvjp(_linear_forward, _linear_backward)


def attend(
    q: Float[Array, "N S h e"], k: Float[Array, "N S h e"], v: Float[Array, "N S h e"], causal: bool
) -> Float[Array, "N S h e"]:
    """Returns softmax(q·kᵀ/√e)·v with operands rounded to bf16, in the number format of q."""
    halves = (x.astype(jnp.bfloat16) for x in (q, k, v))
    return jax.nn.dot_product_attention(*halves, is_causal=causal).astype(q.dtype)


def convolve(x: Float[Array, "B h w C"], kernel: Float[Array, "i j C D"], **settings: Any) -> Float[Array, "B h w D"]:
    """Convolves operands that are rounded to bf16; the result is rounded too, and has the number format of x."""
    out = jax.lax.conv_general_dilated(x.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16), **settings)
    return out.astype(x.dtype)


def convolve_video(
    frames: Float[Array, "B T h w C"], kernel: Float[Array, "3 3 3 C D"], bf16: bool
) -> Float[Array, "B T-2 h w D"]:
    """Returns the 3-D convolution, padded with zeros in space only."""
    dtype = jnp.bfloat16 if bf16 else frames.dtype
    out = jax.lax.conv_general_dilated(
        frames.astype(dtype),
        kernel.astype(dtype),
        window_strides=(1, 1, 1),
        padding=((0, 0), (1, 1), (1, 1)),
        dimension_numbers=("NTHWC", "THWIO", "NTHWC"),
    )
    return out.astype(frames.dtype)
