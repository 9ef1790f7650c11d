"""Tests of attention as one kernel a pass on TPUs: values and gradients, by Pallas' interpreter."""

import jax.numpy as jnp
import pytest

from rsjax.layers.packed_attention import Over
from rsjax.layers.tpu.attention import attend, fits
from tests.layers.attention_reference import assert_like_plain
from tests.layers.kernels import in_dtypes

CASES = [
    ("cells", (1, 2, 128, 3, 4, 32)),  # four heads share a register
    ("cells", (1, 1, 256, 3, 4, 64)),  # two registers
    ("frames", (2, 16, 16, 3, 4, 32)),
    ("frames", (1, 16, 8, 3, 1, 128)),
]


@pytest.mark.parametrize(("over", "shape", "dtype", "bound"), in_dtypes(CASES, 2e-6, interpreted=True))
def test_values_and_gradients_are_those_of_plain_attention(
    over: Over, shape: tuple[int, ...], dtype: jnp.dtype, bound: float
) -> None:
    assert fits(shape, over)
    assert_like_plain(attend, over, shape, dtype, bound)


@pytest.mark.parametrize(
    ("over", "shape"),
    [
        ("cells", (1, 16, 64, 3, 4, 32)),  # cells do not fill the lanes
        ("cells", (1, 16, 256, 3, 2, 32)),  # nor do channels
        ("cells", (1, 16, 256, 3, 4, 48)),  # head width
        ("frames", (1, 8, 256, 3, 4, 32)),
        ("frames", (1, 16, 4, 3, 4, 32)),  # fewer cells than a tile
    ],
)
def test_other_shapes_do_not_fit(over: Over, shape: tuple[int, ...]) -> None:
    assert not fits(shape, over)
