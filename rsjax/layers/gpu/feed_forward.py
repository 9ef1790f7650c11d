"""The two linear layers of a wide transformer block's MLP on GPUs: fc2(gelu(fc1(x))), by Pallas and Triton.

Rows wider than those of :mod:`rsjax.layers.gpu.mlp` do not fit on a multiprocessor. So the first product has a kernel
that applies the GELU before it writes, and the gradient one that computes the first product again beside that of the
cotangent and fc2's kernel: both tiles, and so the GELU's derivative, are on the chip. The other products are plain.

Axes: B clips, T frames, S cells of a frame, C width, H hidden width; N tiles of a clip, R rows and K features of
a tile.
"""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Float

from rsjax.layers.gpu.gelu import gelu
from rsjax.layers.packed_attention import product
from rsjax.layers.parameters import Linear
from rsjax.layers.partition import each_own_clips

ROWS = 128  # of a tile
FEATURES = 128  # of a tile
STEP = 32  # features of x in one step of a product
WARPS = 8
STAGES = 3


def fits(shape: tuple[int, ...], hidden: int) -> bool:
    """Returns whether :func:`feed_forward` takes an x of this shape (B, T, S, C).

    A clip's rows and hidden features are divisible by 128, and the width by 32.
    """
    return math.prod(shape[1:-1]) % ROWS == 0 and hidden % FEATURES == 0 and shape[-1] % STEP == 0


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def feed_forward(
    x: Float[Array, "B T S C"], fc1: Linear, fc2: Linear, interpret: bool = False
) -> Float[Array, "B T S C"]:
    """Returns fc2(gelu(fc1(x))), with the exact GELU.

    Operands of products have x's type; GELU and sums are float32, and so are the parameters' gradients.

    Args:
        x: a shape that :func:`fits`; bfloat16 is fast, float32 is exact.
        interpret: runs without a GPU, slowly.
    """
    return _forward(x, fc1, fc2, interpret)[0]


def _forward(x: Array, fc1: Linear, fc2: Linear, interpret: bool) -> tuple[Array, tuple[Array, Linear, Linear]]:
    with jax.named_scope("feed_forward_forward"):  # a compiler that divides the kernel among devices forgets its name
        h = _run_forward(interpret, x, fc1[0].astype(x.dtype), fc1[1])
    out = _rounded_product(h, fc2[0].astype(x.dtype), 0) + fc2[1].astype(x.dtype)
    return out, (x, fc1, fc2)


def _backward(interpret: bool, saved: tuple[Array, Linear, Linear], cotangent: Array) -> tuple[Array, Linear, Linear]:
    x, fc1, fc2 = saved
    cotangent = cotangent.astype(x.dtype)
    w1, w2 = (kernel.astype(x.dtype) for kernel, _ in (fc1, fc2))
    with jax.named_scope("feed_forward_backward"):
        h, to_h, to_b1 = _run_backward(interpret, x, cotangent, w1, w2, fc1[1])
    to_x = _rounded_product(to_h, w1, 1)
    x, h, to_h, cotangent = (rows.reshape(-1, rows.shape[-1]) for rows in (x, h, to_h, cotangent))
    to_fc1 = product(x, to_h, 0, 0), jnp.sum(to_b1, axis=(0, 1))
    to_fc2 = product(h, cotangent, 0, 0), jnp.sum(cotangent.astype(jnp.float32), axis=0)
    return to_x, to_fc1, to_fc2


feed_forward.defvjp(_forward, _backward)


def _rounded_product(x: Float[Array, "B T S K"], kernel: Array, of_kernel: int) -> Float[Array, "B T S M"]:
    """Returns the product in the number format of x: added up in float32, and never in memory as such."""
    precision = jax.lax.Precision.HIGHEST if x.dtype == jnp.float32 else None
    dims = (((1,), (of_kernel,)), ((), ()))
    out = jax.lax.dot_general(x.reshape(-1, x.shape[-1]), kernel, dims, precision, preferred_element_type=x.dtype)
    return out.reshape(*x.shape[:-1], -1)


@partial(each_own_clips, settings=1, shared=2)
def _run_forward(
    interpret: bool, x: Float[Array, "B T S C"], w1: Float[Array, "C H"], b1: Float[Array, " H"]
) -> Float[Array, "B T S H"]:
    width, hidden = w1.shape
    rows = x.reshape(-1, width)
    h = pl.pallas_call(
        _forward_kernel,
        grid=(hidden // FEATURES, len(rows) // ROWS),
        in_specs=[_across(ROWS, width), _down(width), _down()],
        out_specs=_tile(),
        out_shape=jax.ShapeDtypeStruct((len(rows), hidden), x.dtype),
        compiler_params=triton.CompilerParams(num_warps=WARPS, num_stages=STAGES),
        interpret=interpret,
        name="feed_forward_forward",
    )(rows, w1, b1)
    return h.reshape(*x.shape[:-1], hidden)


@partial(each_own_clips, settings=1, shared=3)
def _run_backward(
    interpret: bool,
    x: Float[Array, "B T S C"],
    cotangent: Float[Array, "B T S C"],
    w1: Float[Array, "C H"],
    w2: Float[Array, "H C"],
    b1: Float[Array, " H"],
) -> tuple[Float[Array, "B T S H"], Float[Array, "B T S H"], Float[Array, "B N H"]]:
    """Returns hidden features and their gradients after the first product, and by tile the gradient of fc1's bias."""
    width, hidden = w1.shape
    rows, of_rows = (array.reshape(-1, width) for array in (x, cotangent))
    tiles = len(rows) // ROWS
    features = jax.ShapeDtypeStruct((len(rows), hidden), x.dtype)
    h, to_h, to_b1 = pl.pallas_call(
        _backward_kernel,
        grid=(hidden // FEATURES, tiles),
        in_specs=[
            _across(ROWS, width),
            _across(ROWS, width),
            _down(width),
            pl.BlockSpec((FEATURES, width), lambda j, i: (j, 0)),
            _down(),
        ],
        out_specs=[_tile(), _tile(), pl.BlockSpec((None, FEATURES), lambda j, i: (i, j))],
        out_shape=[features, features, jax.ShapeDtypeStruct((tiles, hidden), jnp.float32)],
        compiler_params=triton.CompilerParams(num_warps=WARPS, num_stages=STAGES),
        interpret=interpret,
        name="feed_forward_backward",
    )(rows, of_rows, w1, w2, b1)
    h, to_h = (array.reshape(*x.shape[:-1], hidden) for array in (h, to_h))
    return h, to_h, to_b1.reshape(len(x), -1, hidden)


def _across(rows: int, width: int) -> pl.BlockSpec:
    return pl.BlockSpec((rows, width), lambda j, i: (i, 0))


def _down(*width: int) -> pl.BlockSpec:
    return pl.BlockSpec((*width, FEATURES), lambda j, i: (*(0 for _ in width), j))


def _tile() -> pl.BlockSpec:
    return pl.BlockSpec((ROWS, FEATURES), lambda j, i: (i, j))


def _forward_kernel(x: Any, w1: Any, b1: Any, h: Any) -> None:
    def step(i: Any, total: Float[Array, "R K"]) -> Float[Array, "R K"]:
        part = pl.ds(i * STEP, STEP)
        return total + product(x[:, part], w1[part, :], 1, 0)

    total = jax.lax.fori_loop(0, x.shape[1] // STEP, step, jnp.zeros(h.shape, jnp.float32))
    value, _ = gelu(total + b1[...])
    h[...] = value.astype(h.dtype)


def _backward_kernel(x: Any, cotangent: Any, w1: Any, w2: Any, b1: Any, h: Any, to_h: Any, to_b1: Any) -> None:
    def step(i: Any, totals: tuple[Array, Array]) -> tuple[Array, Array]:
        part = pl.ds(i * STEP, STEP)
        first, second = totals
        first = first + product(x[:, part], w1[part, :], 1, 0)
        return first, second + product(cotangent[:, part], w2[:, part], 1, 1)

    zeros = jnp.zeros(h.shape, jnp.float32)
    first, second = jax.lax.fori_loop(0, x.shape[1] // STEP, step, (zeros, zeros))
    value, slope = gelu(first + b1[...])
    gradient = second * slope
    h[...] = value.astype(h.dtype)
    to_h[...] = gradient.astype(to_h.dtype)
    to_b1[...] = jnp.sum(gradient, axis=0)
