"""The matrix product of linear layers and 1×1 convolutions with bf16 operands and float32 accumulation.

CPUs use their bf16 units only for bf16 × bf16 → float32. The default gradient of such a product does not: its
cotangents are float32, and its weight gradient contracts the first axes of both operands, for which XLA has no fast
kernel. So the gradient is hand-written: it casts cotangents too, and transposes the activations in memory.

A CPU without bf16 units multiplies in float32 instead, which is as fast there and saves the casts.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rsjax.runtime import has_bf16_units


def bf16_pays() -> bool:
    """Says whether bf16 operands make products faster: on accelerators, and on CPUs with units for them."""
    return jax.default_backend() != "cpu" or has_bf16_units()


def matmul(x: Float[Array, "N K"], w: Float[Array, "K M"]) -> Float[Array, "N M"]:
    """Returns x·w by :func:`matmul_bf16` where bf16 pays, and in float32 elsewhere."""
    return matmul_bf16(x, w) if bf16_pays() else x @ w


@jax.custom_vjp
def matmul_bf16(x: Float[Array, "N K"], w: Float[Array, "K M"]) -> Float[Array, "N M"]:
    """Returns x·w: operands rounded to bf16, float32 accumulation, in both passes; float32 in and out."""
    return _product(x.astype(jnp.bfloat16), w.astype(jnp.bfloat16), 0)


def _forward(x: Array, w: Array) -> tuple[Array, tuple[Array, Array]]:
    x, w = x.astype(jnp.bfloat16), w.astype(jnp.bfloat16)
    return _product(x, w, 0), (x, w)


def _backward(saved: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    x, w = saved
    cotangent = cotangent.astype(jnp.bfloat16)
    if jax.default_backend() != "cpu":
        return _product(cotangent, w, 1), _product(x.T, cotangent, 0)
    if x.shape[1] <= cotangent.shape[1]:  # transpose the narrower operand
        return _product(cotangent, w, 1), _product(transposed_in_memory(x), cotangent, 0)
    # Without the barrier, XLA swaps the operands back to a form for which it has no bf16 kernel.
    return _product(cotangent, w, 1), jax.lax.optimization_barrier(_product(transposed_in_memory(cotangent), x, 0)).T


def _product(x: Array, w: Array, contract: int) -> Array:
    dimensions = (((1,), (contract,)), ((), ()))
    return jax.lax.dot_general(x, w, dimensions, preferred_element_type=jnp.float32)


def transposed_in_memory(x: Float[Array, "*N K M"]) -> Float[Array, "*N M K"]:
    """Swaps the last two axes and moves the data; a plain transpose only changes the layout of the same memory."""
    y = x.swapaxes(-1, -2)
    return jax.lax.optimization_barrier(y.reshape(-1)).reshape(y.shape)


matmul_bf16.defvjp(_forward, _backward)
