"""A LayerNorm and the linear layer that reads it as one kernel (Pallas, Triton), without a gradient.

A program normalises its rows and multiplies them with some columns of the kernel, so that the norm's output does not go
to memory.

Axes: B clips, T frames, S cells of a frame, C width, D outputs; R rows of a tile.
"""

import math
from functools import partial
from typing import Any

import jax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Array, Float

from rsjax.layers.gpu.norm import layer_norm
from rsjax.layers.packed_attention import product
from rsjax.layers.parameters import Norm
from rsjax.layers.partition import each_own_clips

# Tiles for the shared memory of every card: an RTX 4090 has 99 KB.
ROWS = 64
COLUMNS = 64
WIDTHS = (64, 128, 256)
WARPS = 8
STAGES = 1


def fits(shape: tuple[int, ...], outputs: int) -> bool:
    """Returns whether :func:`norm_linear` takes an x of this shape (B, T, S, C).

    Widths are 64, 128 or 256; a clip's rows and the outputs are divisible by 64.
    """
    return shape[-1] in WIDTHS and math.prod(shape[1:-1]) % ROWS == 0 and outputs % COLUMNS == 0


def norm_linear(
    x: Float[Array, "B T S C"], norm: Norm, kernel: Float[Array, "C D"], interpret: bool = False
) -> Float[Array, "B T S D"]:
    """Returns layer_norm(x)·kernel.

    Operands of the product have x's type; statistics and sums are float32.

    Args:
        x: a shape that :func:`fits`; bfloat16 is fast, float32 is exact.
        interpret: runs without a GPU, slowly.
    """
    outputs = kernel.shape[1]
    width = x.shape[-1]

    def multiply(x: Any, kernel: Any, scale: Any, bias: Any, out: Any) -> None:
        out[...] = product(layer_norm(x[...], (scale[...], bias[...])), kernel[...], 1, 0).astype(out.dtype)

    @partial(each_own_clips, settings=0, shared=3)
    def run(x: Array, kernel: Array, scale: Array, bias: Array) -> tuple[Array]:
        rows = x.reshape(-1, width)
        whole = pl.BlockSpec((width,), lambda i, j: (0,))
        out = pl.pallas_call(
            multiply,
            grid=(len(rows) // ROWS, outputs // COLUMNS),
            in_specs=[
                pl.BlockSpec((ROWS, width), lambda i, j: (i, 0)),
                pl.BlockSpec((width, COLUMNS), lambda i, j: (0, j)),
                whole,
                whole,
            ],
            out_specs=pl.BlockSpec((ROWS, COLUMNS), lambda i, j: (i, j)),
            out_shape=jax.ShapeDtypeStruct((len(rows), outputs), x.dtype),
            compiler_params=triton.CompilerParams(num_warps=WARPS, num_stages=STAGES),
            interpret=interpret,
            name="norm_linear",
        )(rows, kernel, scale, bias)
        return (out.reshape(*x.shape[:-1], outputs),)

    with jax.named_scope("norm_linear"):  # a compiler that divides the kernel among devices forgets its name
        out: Array = run(x, kernel.astype(x.dtype), *norm)[0]
    return out
