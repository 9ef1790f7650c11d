"""A transformer block's MLP as one kernel a pass (Pallas, Triton): x + fc2(gelu(fc1(layer_norm(x)))).

A program holds a tile of rows on a GPU's multiprocessor and goes through the hidden features in chunks, so that neither
the norm's output nor hidden features go to memory. The gradient computes them again from x. Only the weights'
gradients, sums over all rows, need hidden features and their gradients in memory, for a plain product.

Axes: B clips, T frames, S cells of a frame, C width, H hidden width; N tiles of a clip, R rows of a tile, K features of
a chunk.
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
from rsjax.layers.gpu.norm import layer_norm, whiten
from rsjax.layers.packed_attention import product
from rsjax.layers.parameters import Linear, Norm
from rsjax.layers.partition import each_own_clips

# Tiles for the shared memory of every card: an RTX 4090 has 99 KB, less than half of an H100's.
ROWS = 64  # of a tile
ROWS_BACKWARD = 64
CHUNK = 32
WIDTHS = (64, 128, 256)  # accumulators of a wider tile do not fit into registers
WARPS = 8
STAGES = 2
STAGES_BACKWARD = 1


def fits(shape: tuple[int, ...], hidden: int) -> bool:
    """Returns whether :func:`mlp` takes an x of this shape (B, T, S, C).

    Widths are 64, 128 or 256; a clip's rows are divisible by 64, and hidden features by 32.
    """
    return shape[-1] in WIDTHS and math.prod(shape[1:-1]) % ROWS == 0 and hidden % CHUNK == 0


@partial(jax.custom_vjp, nondiff_argnums=(4,))
def mlp(
    x: Float[Array, "B T S C"], norm: Norm | None, fc1: Linear, fc2: Linear, interpret: bool = False
) -> Float[Array, "B T S C"]:
    """Returns x + fc2(gelu(fc1(layer_norm(x)))), with the exact GELU; without ``norm`` fc1 reads x.

    Operands of products have x's type; statistics, GELU and sums are float32, and so are the parameters' gradients.

    Args:
        x: a shape that :func:`fits`; bfloat16 is fast, float32 is exact.
        interpret: runs without a GPU, slowly.
    """
    return _forward(x, norm, fc1, fc2, interpret)[0]


def _forward(
    x: Array, norm: Norm | None, fc1: Linear, fc2: Linear, interpret: bool
) -> tuple[Array, tuple[Array, Norm | None, Linear, Linear]]:
    w1, w2 = (kernel.astype(x.dtype) for kernel, _ in (fc1, fc2))
    shared = (w1, w2, fc1[1], fc2[1], *(norm or ()))
    run = each_own_clips(_run_forward, settings=1, shared=len(shared))
    with jax.named_scope("mlp_forward"):  # a compiler that divides the kernel among devices forgets its name
        return run(interpret, x, *shared), (x, norm, fc1, fc2)


def _backward(
    interpret: bool, saved: tuple[Array, Norm | None, Linear, Linear], cotangent: Array
) -> tuple[Array, Norm | None, Linear, Linear]:
    x, norm, fc1, fc2 = saved
    cotangent = cotangent.astype(x.dtype)
    w1, w2 = (kernel.astype(x.dtype) for kernel, _ in (fc1, fc2))
    shared = (w1, w2, fc1[1], *(norm or ()))
    run = each_own_clips(_run_backward, settings=1, shared=len(shared))
    with jax.named_scope("mlp_backward"):
        to_x, h, to_h, *rest = run(interpret, x, cotangent, *shared)
    normed = rest.pop() if norm else x
    to_b1, to_b2, *to_norm = (jnp.sum(parts, axis=(0, 1)) for parts in rest)
    normed, h, to_h, cotangent = (rows.reshape(-1, rows.shape[-1]) for rows in (normed, h, to_h, cotangent))
    to_fc1 = product(normed, to_h, 0, 0), to_b1
    to_fc2 = product(h, cotangent, 0, 0), to_b2
    return to_x, (to_norm[0], to_norm[1]) if norm else None, to_fc1, to_fc2


mlp.defvjp(_forward, _backward)


def _run_forward(
    interpret: bool,
    x: Float[Array, "B T S C"],
    w1: Float[Array, "C H"],
    w2: Float[Array, "H C"],
    b1: Float[Array, " H"],
    b2: Float[Array, " C"],
    *norm: Float[Array, " C"],
) -> Float[Array, "B T S C"]:
    width = x.shape[-1]
    rows = x.reshape(-1, width)
    out = pl.pallas_call(
        _forward_kernel,
        grid=(len(rows) // ROWS,),
        in_specs=[_rows(ROWS, width), *map(_whole, (w1, w2, b1, b2, *norm))],
        out_specs=_rows(ROWS, width),
        out_shape=jax.ShapeDtypeStruct(rows.shape, x.dtype),
        compiler_params=triton.CompilerParams(num_warps=WARPS, num_stages=STAGES),
        interpret=interpret,
        name="mlp_forward",
    )(rows, w1, w2, b1, b2, *norm)
    return out.reshape(x.shape)


def _run_backward(
    interpret: bool,
    x: Float[Array, "B T S C"],
    cotangent: Float[Array, "B T S C"],
    w1: Float[Array, "C H"],
    w2: Float[Array, "H C"],
    b1: Float[Array, " H"],
    *norm: Float[Array, " C"],
) -> tuple[Array, ...]:
    """Returns gradients and what weights' gradients need.

    They are the gradient of x; hidden features and their gradients; by tile, gradients of both biases and of the norm's
    scale and bias; the norm's output.
    """
    width, hidden = w1.shape
    rows = x.reshape(-1, width)
    tiles = len(rows) // ROWS_BACKWARD
    features = [width, hidden, hidden, *([width] if norm else [])]
    sums = [hidden, width, *(len(one) for one in norm)]
    to_x, h, to_h, *rest = pl.pallas_call(
        partial(_backward_kernel, has_norm=bool(norm)),
        grid=(tiles,),
        in_specs=[_rows(ROWS_BACKWARD, width), _rows(ROWS_BACKWARD, width), *map(_whole, (w1, w2, b1, *norm))],
        out_specs=[
            *(_rows(ROWS_BACKWARD, count) for count in features),
            *(pl.BlockSpec((None, n), _row) for n in sums),
        ],
        out_shape=[
            *(jax.ShapeDtypeStruct((len(rows), count), x.dtype) for count in features),
            *(jax.ShapeDtypeStruct((tiles, count), jnp.float32) for count in sums),
        ],
        compiler_params=triton.CompilerParams(num_warps=WARPS, num_stages=STAGES_BACKWARD),
        interpret=interpret,
        name="mlp_backward",
    )(rows, cotangent.reshape(-1, width), w1, w2, b1, *norm)
    normed = [rest.pop(0).reshape(x.shape)] if norm else []
    by_tile = [parts.reshape(len(x), -1, parts.shape[-1]) for parts in rest]
    return (to_x.reshape(x.shape), *(one.reshape(*x.shape[:-1], hidden) for one in (h, to_h)), *by_tile, *normed)


def _rows(tile: int, width: int) -> pl.BlockSpec:
    return pl.BlockSpec((tile, width), _row)


def _row(i: Any) -> tuple[Any, int]:
    return i, 0


def _whole(parameter: Array) -> pl.BlockSpec:
    return pl.BlockSpec(parameter.shape, lambda _: (0,) * parameter.ndim)


def _forward_kernel(x: Any, w1: Any, w2: Any, b1: Any, b2: Any, *rest: Any) -> None:
    *norm, out = rest
    normed = layer_norm(x[...], [one[...] for one in norm])

    def step(i: Any, total: Float[Array, "R C"]) -> Float[Array, "R C"]:
        part = pl.ds(i * CHUNK, CHUNK)
        h, _ = gelu(product(normed, w1[:, part], 1, 0) + b1[part])
        return total + product(h.astype(x.dtype), w2[part, :], 1, 0)

    total = jax.lax.fori_loop(0, w1.shape[1] // CHUNK, step, x[...].astype(jnp.float32) + b2[...])
    out[...] = total.astype(out.dtype)


def _backward_kernel(x: Any, cotangent: Any, w1: Any, w2: Any, b1: Any, *rest: Any, has_norm: bool) -> None:
    norm = rest[: 2 * has_norm]
    to_x, h, to_h, *outputs = rest[2 * has_norm :]
    normed = layer_norm(x[...], [one[...] for one in norm])
    g = cotangent[...]
    if has_norm:
        outputs.pop(0)[...] = normed
    to_b1, to_b2, *to_norm = outputs
    to_b2[...] = jnp.sum(g.astype(jnp.float32), axis=0)

    def step(i: Any, total: Float[Array, "R C"]) -> Float[Array, "R C"]:
        part = pl.ds(i * CHUNK, CHUNK)
        kernel = w1[:, part]
        value, slope = gelu(product(normed, kernel, 1, 0) + b1[part])
        gradient = product(g, w2[part, :], 1, 1) * slope
        h[:, part] = value.astype(h.dtype)
        to_h[:, part] = gradient.astype(to_h.dtype)
        to_b1[part] = jnp.sum(gradient, axis=0)
        return total + product(gradient.astype(x.dtype), kernel, 1, 1)

    total = jax.lax.fori_loop(0, w1.shape[1] // CHUNK, step, jnp.zeros(x.shape, jnp.float32))
    if has_norm:
        scale, _ = norm
        to_scale, to_bias = to_norm
        whitened, root = whiten(x[...].astype(jnp.float32))
        to_scale[...] = jnp.sum(total * whitened, axis=0)
        to_bias[...] = jnp.sum(total, axis=0)
        total = total * scale[...]
        along = jnp.mean(total * whitened, axis=1, keepdims=True)
        total = root * (total - jnp.mean(total, axis=1, keepdims=True) - whitened * along)
    to_x[...] = (total + cotangent[...].astype(jnp.float32)).astype(to_x.dtype)
