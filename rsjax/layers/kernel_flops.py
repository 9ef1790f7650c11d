"""Operations of kernels that a compiler cannot look into (Pallas), for counts of a program's cost.

All products of a kernel count, as the hardware does them: those that a gradient computes again, pairs that a mask
hides, and the lanes of zeros that stand for other heads on a TPU.
"""

from collections.abc import Sequence
from math import prod

Shapes = Sequence[tuple[int, ...]]

LANES = 128  # of a TPU's register


def attention(qkv: tuple[int, ...], log_sum: tuple[int, ...], of_all_lanes: int, of_head: int) -> int:
    """Returns the operations of attention in tiles (rsjax/layers/gpu/attention.py and tpu/attention.py).

    Each head of a tile multiplies all its R rows with each other.

    Args:
        qkv: shape (B, T, S, 3, h, e) on a GPU, (B, T, S, 3·h·e) on a TPU.
        log_sum: shape (B, N, h, R), for N tiles of R rows.
        of_all_lanes: products which on a TPU have lanes of all heads in a register, those of one being nonzero.
        of_head: products of one head's channels.
    """
    clips, tiles, heads, rows = log_sum
    width = prod(qkv[3:]) // (3 * heads)
    on_tpu = len(qkv) == 4
    lanes = LANES if on_tpu else width
    return 2 * clips * tiles * heads * rows**2 * (of_all_lanes * lanes + of_head * width)


def over_cache(qkv: tuple[int, ...], keys: tuple[int, ...]) -> int:
    """Returns the operations of attention over a cache: each query's with all slots and the new frames up to its own.

    Args:
        qkv: shape (B, F, S, 3, h, e).
        keys: shape (B, S, h, N, e).
    """
    clips, frames, cells, _, heads, width = qkv
    pairs = frames * keys[3] + frames * (frames + 1) // 2
    return 4 * clips * cells * heads * pairs * width


def products(rows: tuple[int, ...], kernel: tuple[int, ...], count: int) -> int:
    """Returns the operations of ``count`` products of rows (N, C) and a kernel (C, H) or its transpose."""
    return count * 2 * rows[0] * prod(kernel)


# The kernels of attention in tiles, by pallas_call's ``name``: products of all lanes, and of one head's.
ATTENTION = {
    "attend_cells_forward": (1, 1),
    "attend_cells_backward": (2, 3),
    "attend_frames_forward": (1, 1),
    "attend_frames_backward": (2, 3),
}
# The kernels that multiply rows, their first operand, likewise: which operand has the shape of the weights, and how
# many products there are.
PRODUCTS = {
    "norm_linear": (1, 1),
    "mlp_forward": (1, 2),
    "mlp_backward": (2, 3),
    "feed_forward_forward": (1, 1),
    "feed_forward_backward": (2, 2),
}
KERNELS = (*ATTENTION, "attend_cache", *PRODUCTS)


def kernel_flops(name: str, operands: Shapes, results: Shapes) -> int:
    """Returns the operations of one call of a kernel, 2 per multiply-add.

    Args:
        name: one of :data:`KERNELS`.
        operands: their shapes.
        results: their shapes.
    """
    if name == "attend_cache":
        return over_cache(operands[0], operands[1])
    if name in PRODUCTS:
        weights, count = PRODUCTS[name]
        return products(operands[0], operands[weights], count)
    if name.endswith("backward"):
        log_sum = operands[3]
    else:
        log_sum = results[1]
    return attention(operands[0], log_sum, *ATTENTION[name])
