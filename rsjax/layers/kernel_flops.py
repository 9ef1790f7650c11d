"""Operations of kernels that a compiler cannot look into (Pallas), for counts of a program's cost."""

from collections.abc import Callable, Sequence
from math import prod

from rsjax.layers import packed_attention
from rsjax.layers.gpu import feed_forward, mlp

Shapes = Sequence[tuple[int, ...]]


def attention(products: int) -> Callable[[Shapes, Shapes], float]:
    """Returns the count of an attention kernel with so many products of queries × keys × width.

    Its first operands are queries (B, T, heads, width) and keys (B, S, heads, width). The forward pass has 2 products,
    the backward pass 5, since it computes the scores again.
    """

    def count(operands: Shapes, results: Shapes) -> float:
        keys = operands[1][1]
        return products * 2 * prod(operands[0]) * keys

    return count


# By the kernel's name, which is pallas_call's ``name`` or that of the jitted function around it: a function of the
# shapes of operands and results that returns the operations of one call, 2 per multiply-add.
KERNEL_FLOPS: dict[str, Callable[[Shapes, Shapes], float]] = {
    "mha_forward": attention(2),  # jax.experimental.pallas.ops.gpu.attention
    "mha_preprocess_backward": lambda operands, results: 2 * prod(operands[0]),
    "mha_backward": attention(5),
    "attend_cells_forward": lambda operands, results: packed_attention.flops(operands[0], "cells")[0],
    "attend_cells_backward": lambda operands, results: packed_attention.flops(operands[0], "cells")[1],
    "attend_frames_forward": lambda operands, results: packed_attention.flops(operands[0], "frames")[0],
    "attend_frames_backward": lambda operands, results: packed_attention.flops(operands[0], "frames")[1],
    "mlp_forward": lambda operands, results: mlp.flops(operands[0][0], *operands[1]),
    "mlp_backward": lambda operands, results: mlp.flops(operands[0][0], *operands[2]),
    "feed_forward_forward": lambda operands, results: feed_forward.flops(operands[0][0], *operands[1]),
    "feed_forward_backward": lambda operands, results: feed_forward.flops(operands[0][0], *operands[2]),
}
