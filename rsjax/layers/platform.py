"""The one place that asks which processor runs, and chooses the implementation; other layers and models do not ask.

Axes: N rows, frames or sequences, S cells, h heads, e head width; B images, h×w cells, C and D channels, i×j a kernel.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax import runtime
from rsjax.layers.attention import attend
from rsjax.layers.cpu import convolution, frame_attention
from rsjax.layers.cpu.gelu import gelu
from rsjax.layers.cpu.matmul import product, weight_gradient

__all__ = ["attend_cells", "convolve", "gelu", "matmul", "matmul_bf16", "on_cpu"]


def on_cpu() -> bool:
    """Returns whether programs run on a CPU."""
    return jax.default_backend() == "cpu"


def matmul(x: Float[Array, "N K"], w: Float[Array, "K M"]) -> Float[Array, "N M"]:
    """Returns x·w by :func:`matmul_bf16`, or in float32 on CPUs without bf16 units, where this is as fast."""
    if on_cpu() and not runtime.has_bf16_units():
        return x @ w
    return matmul_bf16(x, w)


@jax.custom_vjp
def matmul_bf16(x: Float[Array, "N K"], w: Float[Array, "K M"]) -> Float[Array, "N M"]:
    """Returns x·w: operands rounded to bf16, float32 accumulation, in both passes; float32 in and out.

    The gradient is hand-written because the default one does not round cotangents, and so does not use bf16 units.
    """
    return product(x.astype(jnp.bfloat16), w.astype(jnp.bfloat16))


def _forward(x: Array, w: Array) -> tuple[Array, tuple[Array, Array]]:
    x = x.astype(jnp.bfloat16)
    w = w.astype(jnp.bfloat16)
    return product(x, w), (x, w)


def _backward(saved: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    x, w = saved
    cotangent = cotangent.astype(jnp.bfloat16)
    to_x = product(cotangent, w, 1)
    if on_cpu():
        return to_x, weight_gradient(x, cotangent)
    return to_x, product(x.T, cotangent)


matmul_bf16.defvjp(_forward, _backward)


def attend_cells(
    q: Float[Array, "*N S h e"],
    k: Float[Array, "*N S h e"],
    v: Float[Array, "*N S h e"],
    bf16: bool,
    causal: bool = False,
) -> Float[Array, "*N S h e"]:
    """Returns :func:`rsjax.layers.attention.attend` within each frame or sequence.

    Args:
        bf16: whether products may round their operands to bf16.
        causal: whether a query sees only its own key and those before it.
    """
    cells = q.shape[-3]
    frames = [x.reshape(-1, *x.shape[-3:]) for x in (q, k, v)]
    if bf16 and not on_cpu():
        halves = (x.astype(jnp.bfloat16) for x in frames)
        out = jax.nn.dot_product_attention(*halves, is_causal=causal).astype(q.dtype)
    elif bf16 and cells >= frame_attention.LARGE_FRAME:
        out = frame_attention.attend_in_frames(frames[0], frames[1], frames[2], causal)
    else:
        out = attend(frames[0], frames[1], frames[2], jnp.tri(cells, dtype=bool) if causal else None)
    return out.reshape(q.shape)


def convolve(
    x: Float[Array, "B h w C"],
    kernel: Float[Array, "i j C D"],
    window_strides: Sequence[int],
    padding: Any,
    **settings: Any,  # axes must be in the order of flax's layers
) -> Float[Array, "B h w D"]:
    """Convolves as ``jax.lax.conv_general_dilated`` does, with operands rounded to bf16 where this is faster.

    On an accelerator the result is rounded to bf16 too, as in the layers of other libraries.
    """
    if not on_cpu():
        x = x.astype(jnp.bfloat16)
        kernel = kernel.astype(jnp.bfloat16)
        return jax.lax.conv_general_dilated(x, kernel, window_strides, padding, **settings).astype(jnp.float32)
    if not convolution.multiplies(x, kernel, window_strides, padding, settings):
        return jax.lax.conv_general_dilated(x, kernel, window_strides, padding, **settings)
    if len(kernel) == 1:
        return matmul_bf16(x.reshape(-1, x.shape[-1]), kernel[0, 0]).reshape(*x.shape[:-1], -1)
    return convolution.conv_bf16(x, kernel)
