"""What the kernels of attention on GPUs and on TPUs share.

A kernel works on tiles: a frame, over whose cells it attends, or all frames of neighbouring cells, each of which
attends over frames. It takes the output of the qkv projection as it is, packed, and writes the packed gradient.
"""

import math
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

Over = Literal["cells", "frames"]

ATTENTION = "attention"  # the name of the output and the log-sums in rematerialisation policies
HEAD_WIDTHS = (16, 32, 64, 128)


class Tile(NamedTuple):
    """The tokens that one program sees; rows are (frame, cell)."""

    frames: int
    cells: int

    @property
    def rows(self) -> int:
        return self.frames * self.cells


def scale(width: int) -> float:
    """Returns the factor of scores: 1/√e, for powers of two, which are faster than those of e."""
    return math.log2(math.e) / math.sqrt(width)


def sees(tile: Tile, query: Int[Array, "*q"], key: Int[Array, "*k"]) -> Bool[Array, "*qk"]:
    """Returns whether a query's row and a key's are of one cell and the key's is not of a later frame."""
    return ((query ^ key) & (tile.cells - 1) == 0) & (query >= key)


def product(a: Float[Array, "i j"], b: Float[Array, "k l"], of_a: int, of_b: int) -> Float[Array, "m n"]:
    """Returns the float32 product along an axis of each operand."""
    precision = jax.lax.Precision.HIGHEST if a.dtype == jnp.float32 else None
    dims = (((of_a,), (of_b,)), ((), ()))
    return jax.lax.dot_general(a, b, dims, precision=precision, preferred_element_type=jnp.float32)
