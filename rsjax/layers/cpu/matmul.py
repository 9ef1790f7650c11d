"""Products with bf16 operands in the one form for which CPUs use their bf16 units: bf16 × bf16 → float32.

XLA's CPU backend has fast kernels only if the last axis of the first operand is contracted. So the gradient of weights,
which contracts the first axes of both operands, transposes one of them in memory.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, BFloat16, Float

from rsjax import runtime


def linear(x: Float[Array, "N K"], w: Float[Array, "K M"], bias: Float[Array, " M"] | None) -> Float[Array, "N M"]:
    """Returns x·w + bias by :func:`matmul_bf16`, or in float32 on CPUs without bf16 units, where this is as fast."""
    multiply = matmul_bf16 if runtime.has_bf16_units() else jnp.matmul
    out = multiply(x, w).astype(x.dtype)
    if bias is None:
        return out
    return out + bias.astype(x.dtype)


@jax.custom_vjp
def matmul_bf16(x: Float[Array, "N K"], w: Float[Array, "K M"]) -> Float[Array, "N M"]:
    """Returns x·w in the number format of x: operands rounded to bf16, sums in float32, in both passes.

    The gradient is hand-written because the default one does not round cotangents, and so does not use bf16 units.
    """
    return product(x.astype(jnp.bfloat16), w.astype(jnp.bfloat16)).astype(x.dtype)


def _forward(x: Array, w: Array) -> tuple[Array, tuple[Array, Array]]:
    w = w.astype(jnp.bfloat16)
    return matmul_bf16(x, w), (x.astype(jnp.bfloat16), w)


def _backward(saved: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    x, w = saved
    rounded = cotangent.astype(jnp.bfloat16)
    return product(rounded, w, 1).astype(cotangent.dtype), weight_gradient(x, rounded)


matmul_bf16.defvjp(_forward, _backward)


def product(x: Float[Array, "N K"], w: Float[Array, "..."], contract: int = 0) -> Float[Array, "N M"]:
    """Returns x·w in float32, contracting axis ``contract`` of w."""
    return jax.lax.dot_general(x, w, (((1,), (contract,)), ((), ())), preferred_element_type=jnp.float32)


def weight_gradient(x: BFloat16[Array, "N K"], cotangent: BFloat16[Array, "N M"]) -> Float[Array, "K M"]:
    """Returns xᵀ·cotangent; transposes the narrower operand in memory."""
    if x.shape[1] <= cotangent.shape[1]:
        return product(transposed_in_memory(x), cotangent)
    # Without the barrier, XLA swaps the operands back to a form for which it has no bf16 kernel.
    return jax.lax.optimization_barrier(product(transposed_in_memory(cotangent), x)).T


def transposed_in_memory(x: Float[Array, "*N K M"]) -> Float[Array, "*N M K"]:
    """Swaps the last two axes and moves the data; a plain transpose only changes the layout of the same memory."""
    y = x.swapaxes(-1, -2)
    return jax.lax.optimization_barrier(y.reshape(-1)).reshape(y.shape)
