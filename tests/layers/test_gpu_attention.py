"""Tests of attention as one kernel a pass on GPUs: values and gradients, on the GPU, or else by Pallas' interpreter."""

import jax.numpy as jnp
import pytest

from rsjax.layers.gpu.attention import attend, fits
from rsjax.layers.packed_attention import Over
from tests.layers.attention_reference import assert_like_plain
from tests.layers.kernels import in_dtypes

CASES = [
    ("cells", (2, 3, 16, 3, 2, 16)),
    ("cells", (1, 1, 256, 3, 1, 32)),  # several steps of both loops
    ("frames", (2, 16, 8, 3, 2, 32)),
    ("frames", (1, 4, 16, 3, 1, 16)),
]


@pytest.mark.parametrize(("over", "shape", "dtype", "bound"), in_dtypes(CASES, 2e-6))
def test_values_and_gradients_are_those_of_plain_attention(
    over: Over, shape: tuple[int, ...], dtype: jnp.dtype, bound: float
) -> None:
    assert fits(shape, over)
    assert_like_plain(attend, over, shape, dtype, bound)


@pytest.mark.parametrize(
    ("over", "shape"),
    [
        ("cells", (1, 16, 8, 3, 1, 16)),  # too few cells
        ("cells", (1, 16, 320, 3, 1, 16)),  # no power of two
        ("cells", (1, 16, 256, 3, 1, 24)),  # head width
        ("frames", (1, 12, 256, 3, 1, 16)),
        ("frames", (1, 16, 2, 3, 1, 16)),  # fewer cells than a tile
        ("frames", (1, 1, 64, 3, 1, 16)),  # a tile of one frame attends over its cells
    ],
)
def test_other_shapes_do_not_fit(over: Over, shape: tuple[int, ...]) -> None:
    assert not fits(shape, over)
