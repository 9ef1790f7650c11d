"""A residual sum and its LayerNorm as one kernel a pass on GPUs (Pallas, Triton).

XLA makes three kernels of it forward and seven backward, which read and write a block's features about twice as often.

Axes: B clips, N tokens of a clip, C channels.
"""

from functools import partial
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Float

from rsjax.layers.partition import each_own_clips

EPSILON = 1e-5
ELEMENTS = 2048  # of one step of a program
STEPS = 16  # of a program of the backward pass, which sums the gradients of scale and bias
WARPS = 4


def fits(shape: tuple[int, ...]) -> bool:
    """Returns whether :func:`add_norm` takes features of this shape (B, ..., C).

    C is a power of two from 128 to 2048, and the tokens of a clip are divisible by 16 · 2048/C.
    """
    _, *tokens, channels = shape
    if channels not in (128, 256, 512, 1024, 2048):
        return False
    return prod(tokens) % (STEPS * ELEMENTS // channels) == 0


@partial(jax.custom_vjp, nondiff_argnums=(4,))
def add_norm(
    x: Float[Array, "B *N C"],
    update: Float[Array, "B *N C"] | None,
    scale: Float[Array, " C"],
    bias: Float[Array, " C"],
    interpret: bool = False,
) -> tuple[Float[Array, "B *N C"], Float[Array, "B *N C"]]:
    """Returns x + update, rounded to x's type, and its LayerNorm, whose statistics are float32.

    Args:
        x: features of a shape that :func:`fits`.
        update: None for x itself, whose gradients by both ways the kernel then adds up.
        interpret: runs without a GPU, slowly.
    """
    return _forward(x, update, scale, bias, interpret)[0]


def _forward(x: Array, update: Array | None, scale: Array, bias: Array, interpret: bool) -> tuple[Any, Any]:
    operands = [_flat(x)]
    if update is not None:
        operands.append(_flat(update))
    with jax.named_scope("add_norm_forward"):  # a compiler that divides the kernel among devices forgets its name
        results = _run_forward(interpret, *operands, scale[None], bias[None])
    total, normed = [*operands, *results][-2:]
    return (total.reshape(x.shape), normed.reshape(x.shape)), (total, scale, [None] * (update is not None))


def _backward(interpret: bool, saved: Any, cotangents: tuple[Array, Array]) -> tuple[Any, ...]:
    total, scale, added = saved
    of_total, of_normed = (_flat(g) for g in cotangents)
    with jax.named_scope("add_norm_backward"):
        gradient, sums = _run_backward(interpret, total, of_total, of_normed, scale[None])
    gradient = gradient.reshape(cotangents[0].shape)
    of_scale, of_bias = jnp.sum(sums, axis=(0, 1))
    of_update = None
    if added:
        of_update = gradient
    return gradient, of_update, of_scale, of_bias


add_norm.defvjp(_forward, _backward)


@partial(each_own_clips, settings=1, shared=2)
def _run_forward(interpret: bool, *operands: Array) -> list[Array]:
    """Returns the sum, if there are two operands beside scale and bias, and its LayerNorm."""
    *features, _, _ = operands
    clips, tokens, channels = features[0].shape
    rows = ELEMENTS // channels
    block = pl.BlockSpec((None, rows, channels), lambda clip, n: (clip, n, 0))
    row = pl.BlockSpec((None, channels), lambda clip, n: (0, 0))
    return pl.pallas_call(
        _forward_kernel,
        grid=(clips, tokens // rows),
        in_specs=[*(block for _ in features), row, row],
        out_specs=[block for _ in features],
        out_shape=[jax.ShapeDtypeStruct(x.shape, features[0].dtype) for x in features],
        compiler_params=triton.CompilerParams(num_warps=WARPS, num_stages=1),
        interpret=interpret,
        name="add_norm_forward",
    )(*operands)


@partial(each_own_clips, settings=1, shared=1)
def _run_backward(
    interpret: bool,
    total: Float[Array, "B N C"],
    of_total: Float[Array, "B N C"],
    of_normed: Float[Array, "B N C"],
    scale: Float[Array, "1 C"],
) -> list[Array]:
    """Returns the gradient of the sum, and parts of those of scale and bias, (B, programs, 2, C)."""
    clips, tokens, channels = total.shape
    rows = ELEMENTS // channels
    programs = tokens // (rows * STEPS)
    block = pl.BlockSpec((None, rows * STEPS, channels), lambda clip, n: (clip, n, 0))
    row = pl.BlockSpec((None, channels), lambda clip, n: (0, 0))
    return pl.pallas_call(
        partial(_backward_kernel, rows=rows),
        grid=(clips, programs),
        in_specs=[block, block, block, row],
        out_specs=[block, pl.BlockSpec((None, None, 2, channels), lambda clip, n: (clip, n, 0, 0))],
        out_shape=[
            jax.ShapeDtypeStruct(total.shape, total.dtype),
            jax.ShapeDtypeStruct((clips, programs, 2, channels), jnp.float32),
        ],
        compiler_params=triton.CompilerParams(num_warps=WARPS, num_stages=1),
        interpret=interpret,
        name="add_norm_backward",
    )(total, of_total, of_normed, scale)


def _forward_kernel(*refs: Any) -> None:
    *inputs, scale, bias = refs[: len(refs) // 2 + 1]
    outputs = refs[len(refs) // 2 + 1 :]
    total = inputs[0][...]
    if len(inputs) == 2:
        total = (total.astype(jnp.float32) + inputs[1][...].astype(jnp.float32)).astype(total.dtype)
        outputs[0][...] = total
    normed, _ = _normed(total)
    outputs[-1][...] = (normed * scale[...] + bias[...]).astype(total.dtype)


def _backward_kernel(
    total: Any, of_total: Any, of_normed: Any, scale: Any, gradient: Any, sums: Any, *, rows: int
) -> None:
    def step(i: Any, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        of_scale, of_bias = carry
        here = pl.ds(i * rows, rows)
        normed, shrink = _normed(total[here])
        g = of_normed[here].astype(jnp.float32)
        scaled = g * scale[...]
        centred = scaled - _mean(scaled) - normed * _mean(scaled * normed)
        gradient[here] = (of_total[here].astype(jnp.float32) + centred * shrink).astype(gradient.dtype)
        return of_scale + g * normed, of_bias + g

    zeros = jnp.zeros((rows, total.shape[-1]), jnp.float32)
    of_scale, of_bias = jax.lax.fori_loop(0, STEPS, step, (zeros, zeros))
    sums[0] = jnp.sum(of_scale, axis=0)
    sums[1] = jnp.sum(of_bias, axis=0)


def _normed(x: Array) -> tuple[Float[Array, "R C"], Float[Array, "R 1"]]:
    """Returns rows of mean 0 and variance 1, and the factor that gives them this variance."""
    centred = x.astype(jnp.float32)
    centred -= _mean(centred)
    shrink = jax.lax.rsqrt(_mean(centred**2) + EPSILON)
    return centred * shrink, shrink


def _mean(x: Array) -> Float[Array, "R 1"]:
    return jnp.sum(x, axis=1)[:, None] / x.shape[1]


def _flat(x: Array) -> Float[Array, "B N C"]:
    return x.reshape(len(x), -1, x.shape[-1])
