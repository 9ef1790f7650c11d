"""3×3 convolutions with 2.25 times fewer multiplications: F(2×2, 3×3) of Lavin & Gray 2016 (arXiv 1509.09308).

A tile of 4×4 cells gives 2×2 cells of the result; neighbouring tiles overlap by two cells. Sums and differences of a
tile's cells are multiplied by as many of the kernel's, and sums of these 16 products are the result. Operands of the
products are rounded to bf16 as in ``convolution.py``. The rounding error is 1.65 times that of its products, measured
with random numbers.

The kernel's sums take as long as a third of a small image's convolution, so they are made once for many images.

Axes: B images, h×w cells, C channels in, D channels out, r×s tiles.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, BFloat16, Float

from rsjax.layers.cpu.convolution import LEAST

MOST = 2**22  # numbers in all products: 16 MiB; more leave the processor's cache


def transformed_kernel(kernel: Float[Array, "3 3 C D"]) -> BFloat16[Array, "16 C D"]:
    """Returns the kernel as :func:`convolve_transformed` takes it."""
    return jnp.stack([each.astype(jnp.bfloat16) for row in _of_kernel(kernel) for each in _of_kernel(row)])


def transforms(kernel: Float[Array, "..."]) -> bool:
    """Returns whether a convolution with this kernel is faster so."""
    return kernel.shape[:2] == (3, 3) and min(kernel.shape[2:]) >= LEAST


def takes(x: Float[Array, "B h w C"], kernel: Float[Array, "16 C D"]) -> bool:
    """Returns whether images have whole tiles, and few enough of them for the processor's cache."""
    images, height, width, _ = x.shape
    return height % 2 == width % 2 == 0 and 4 * images * height * width * kernel.shape[-1] <= MOST


def convolve_transformed(x: Float[Array, "B h w C"], kernel: BFloat16[Array, "16 C D"]) -> Float[Array, "B h w D"]:
    """Convolves with stride 1 and zeros around images of even height and width."""
    images, height, width, channels = x.shape
    padded = jnp.pad(x.astype(jnp.float32), ((0, 0), (1, 1), (1, 1), (0, 0)))
    cells = [each for rows in _of_tiles(_cells(padded, 1)) for each in _of_tiles(_cells(rows, 2))]
    # XLA would copy bf16 through float32, three times as slowly as whole numbers.
    numbers = jnp.stack([jax.lax.bitcast_convert_type(each.astype(jnp.bfloat16), jnp.uint16) for each in cells])
    numbers = jax.lax.optimization_barrier(numbers.reshape(16, -1, channels))
    rounded = jax.lax.bitcast_convert_type(numbers, jnp.bfloat16)
    # One product of all, since 16 take seconds to compile.
    multiplied = jax.lax.dot_general(rounded, kernel, (((2,), (1,)), ((0,), (0,))), preferred_element_type=jnp.float32)
    products = jax.lax.optimization_barrier(multiplied).reshape(16, images, height // 2, width // 2, -1)
    columns = [_of_products([products[4 * row + column] for row in range(4)]) for column in range(4)]
    out = [_of_products([column[row] for column in columns]) for row in range(2)]
    whole = jnp.stack([jnp.stack(row, axis=3) for row in out], axis=2)  # B r 2 s 2 D
    return whole.reshape(images, height, width, -1).astype(x.dtype)


def _cells(x: Float[Array, "..."], axis: int) -> list[Array]:
    """Returns the first, second, third and fourth cells of all tiles along an axis."""
    last = x.shape[axis] - 3
    return [jax.lax.slice_in_dim(x, first, first + last, stride=2, axis=axis) for first in range(4)]


def _of_kernel(g: Array) -> list[Array]:
    """Returns G·g, of the kernel's three rows or columns."""
    return [g[0], (g[0] + g[1] + g[2]) / 2, (g[0] - g[1] + g[2]) / 2, g[2]]


def _of_tiles(d: list[Array]) -> list[Array]:
    """Returns Bᵀ·d, of the tiles' four rows or columns."""
    return [d[0] - d[2], d[1] + d[2], d[2] - d[1], d[1] - d[3]]


def _of_products(m: list[Array]) -> list[Array]:
    """Returns Aᵀ·m, two rows or columns of the result, of the four of the products."""
    return [m[0] + m[1] + m[2], m[1] - m[2] - m[3]]
