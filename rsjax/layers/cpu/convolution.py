"""Convolutions as matrix products with bf16 operands and float32 accumulation.

XLA's CPU backend convolves in float32 whatever its operands are. It does not use bf16 units, and for small images only
one core. So a 3×3 convolution becomes products over the whole image: three neighbouring cells of a row lie side by side
in memory and are multiplied by a row of the kernel, and the results of its three rows are added, each shifted by a row
of the image. Large images are cut into strips, so that the copies stay in the processor's cache.

Axes: B images, h×w cells, C channels in, D channels out, i×j cells of a kernel, N = B·h·w.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, BFloat16, Float

from rsjax import runtime
from rsjax.layers.cpu.matmul import matmul_bf16, product, transposed_in_memory

LEAST = 32  # channels, in and out, from which the products save more time than their copies of the image cost
WIDE = 128  # channels out from which a product for each row of the kernel is as fast as one product for all rows
STRIP = 2**20  # numbers in an unfolded strip: 2 MiB
WRITTEN_OUT = 8  # strips that are computed without a loop; more take longer to compile


def convolve(x: Float[Array, "B h w C"], kernel: Float[Array, "i j C D"], **settings: Any) -> Float[Array, "B h w D"]:
    """Convolves as ``jax.lax.conv_general_dilated`` does, as products with bf16 operands where these are faster."""
    if not multiplies(x, kernel, settings):
        return jax.lax.conv_general_dilated(x, kernel.astype(x.dtype), **settings)
    if len(kernel) == 1:
        return matmul_bf16(x.reshape(-1, x.shape[-1]), kernel[0, 0]).reshape(*x.shape[:-1], -1)
    return conv_bf16(x.astype(jnp.float32), kernel.astype(jnp.float32)).astype(x.dtype)


def convolve_video(
    frames: Float[Array, "B T h w C"], kernel: Float[Array, "3 3 3 C D"], bf16: bool
) -> Float[Array, "B T-2 h w D"]:
    """Returns the 3-D convolution, padded with zeros in space only, as one in 2-D of three frames side by side."""
    size = len(kernel)
    count = frames.shape[1] - size + 1
    stacked = jnp.concatenate([frames[:, i : i + count] for i in range(size)], axis=-1)
    flat = kernel.transpose(1, 2, 0, 3, 4).reshape(size, size, -1, kernel.shape[-1])
    run = convolve if bf16 else jax.lax.conv_general_dilated
    out = run(
        stacked.reshape(-1, *stacked.shape[2:]),
        flat,
        window_strides=(1, 1),
        padding=((1, 1), (1, 1)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    return out.reshape(*stacked.shape[:2], *out.shape[1:])


def multiplies(x: Array, kernel: Array, settings: dict[str, Any]) -> bool:
    """Returns whether products compute this convolution, and faster than XLA does."""
    size = len(kernel)
    padding = settings["padding"]
    around = padding == "SAME" or all(tuple(each) == (size // 2, size // 2) for each in padding)
    square = kernel.shape[1] == size and size % 2 == 1
    plain = {
        *settings["window_strides"],
        *(settings.get("lhs_dilation") or ()),
        *(settings.get("rhs_dilation") or ()),
    } == {1}
    wide = min(kernel.shape[2:]) >= LEAST and kernel.shape[2] == x.shape[-1]
    return around and square and plain and wide and runtime.has_bf16_units()


@jax.custom_vjp
def conv_bf16(x: Float[Array, "B h w C"], kernel: Float[Array, "i i C D"]) -> Float[Array, "B h w D"]:
    """Convolves with an odd kernel and stride 1, with zeros around the image; operands are rounded to bf16."""
    return _in_strips(lambda total, strip: (total, _products(strip, kernel)), (), len(kernel), x)[1]


def _forward(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return conv_bf16(x, kernel), (x.astype(jnp.bfloat16), kernel)


def _backward(saved: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    x, kernel = saved
    size, _, inputs, outputs = kernel.shape
    turned = kernel[::-1, ::-1].swapaxes(2, 3)

    def gradients(total: Array, strip: Array, x: Array) -> tuple[Array, Array]:
        # Shifting the image against the cotangent is the same as shifting the cotangent the other way, and the
        # cotangent is unfolded anyway. Without the barrier, XLA swaps the operands to a form without a bf16 kernel.
        across = transposed_in_memory(x.reshape(-1, inputs))  # C N
        rows = [jax.lax.optimization_barrier(product(across, row)) for row in _rows(strip, size)]
        return total + jnp.stack(rows), _products(strip, turned)

    zeros = jnp.zeros((size, inputs, size * outputs))
    of_kernel, of_x = _in_strips(gradients, zeros, size, cotangent, x)
    of_kernel = of_kernel.reshape(size, inputs, size, outputs)[::-1, :, ::-1]
    return of_x, of_kernel.swapaxes(1, 2)


def _in_strips(
    run: Callable[..., tuple[Any, Array]],
    total: Any,
    size: int,
    x: Float[Array, "B h w C"],
    *beside: Float[Array, "B h w E"],
) -> tuple[Any, Float[Array, "B h w D"]]:
    """Runs a function on strips of images that fit the processor's cache, one after another.

    If one program serves several devices (``mesh``), XLA gathers the sharded batch before it is cut; under ``pmap``
    each device cuts its own part.

    Args:
        run: takes a total, an unfolded strip of ``x`` and the same strips of the other maps; returns a new total and a
            strip of the result.
        total: the initial total.
        size: of the kernel.

    Returns:
        The last total, and the results put together.
    """
    images, height, width, _ = x.shape
    around = size // 2
    numbers = width * size * x.shape[-1]  # of a row
    rows = max(n for n in range(1, height + 1) if height % n == 0 and (n == 1 or n * numbers <= STRIP))
    many = max(n for n in range(1, images + 1) if images % n == 0 and (n == 1 or n * height * numbers <= STRIP))
    # Whole images get their zeros strip by strip: a strip of an array that XLA has padded before is unfolded slowly.
    within, before = (around, 0) if rows == height else (0, around)
    padded = jnp.pad(x, ((0, 0), (before, before), (0, 0), (0, 0)))

    def strip(total: Any, place: tuple[Array, Array]) -> tuple[Any, Array]:
        def cut(y: Array, rows: int) -> Array:
            return jax.lax.dynamic_slice(y, (*place, 0, 0), (many, rows, *y.shape[2:]))

        zeros = ((0, 0), (within, within), (around, around), (0, 0))
        return run(total, _unfold(cut(padded, rows + 2 * before), zeros, size), *(cut(y, rows) for y in beside))

    first, top = jnp.meshgrid(jnp.arange(0, images, many), jnp.arange(0, height, rows), indexing="ij")
    # XLA runs most of a loop's body on one core.
    unroll = first.size if first.size <= WRITTEN_OUT else 1
    total, strips = jax.lax.scan(strip, total, (first.reshape(-1), top.reshape(-1)), unroll=unroll)
    return total, strips.reshape(images, height, width, -1)


def _unfold(
    strip: Float[Array, "B h w C"], zeros: Sequence[tuple[int, int]], size: int
) -> BFloat16[Array, "B h2 w jC"]:
    """Pads a strip with zeros, and puts the cells of each kernel's row side by side."""
    # XLA would copy bf16 through float32, three times as slowly as whole numbers.
    numbers = jnp.pad(jax.lax.bitcast_convert_type(strip.astype(jnp.bfloat16), jnp.uint16), zeros)
    unfolded = jnp.concatenate([numbers[:, :, j : j + strip.shape[2]] for j in range(size)], axis=-1)
    return jax.lax.bitcast_convert_type(jax.lax.optimization_barrier(unfolded), jnp.bfloat16)


def _rows(unfolded: BFloat16[Array, "B h2 w jC"], size: int) -> list[BFloat16[Array, "N jC"]]:
    """Returns the inputs of each row of the kernel at every cell."""
    height = unfolded.shape[1] - size + 1
    return [unfolded[:, i : i + height].reshape(-1, unfolded.shape[-1]) for i in range(size)]


def _products(unfolded: BFloat16[Array, "B h2 w jC"], kernel: Float[Array, "i i C D"]) -> Float[Array, "B h w D"]:
    size = len(kernel)
    outputs = kernel.shape[-1]
    # A row at a time: XLA would cast the whole kernel first, and then copy its rows.
    kernels = [row.reshape(-1, outputs).astype(jnp.bfloat16) for row in kernel]
    images, height, width, _ = unfolded.shape
    height -= size - 1
    if outputs >= WIDE:
        parts = [product(row, one) for row, one in zip(_rows(unfolded, size), kernels, strict=True)]
    else:
        joined = product(unfolded.reshape(-1, unfolded.shape[-1]), jnp.concatenate(kernels, axis=-1))
        whole = joined.reshape(images, -1, width, size, outputs)
        parts = [whole[:, i : i + height, :, i] for i in range(size)]
    return jnp.reshape(sum(parts[1:], start=parts[0]), (images, height, width, outputs))


conv_bf16.defvjp(_forward, _backward)
