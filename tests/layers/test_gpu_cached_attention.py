"""Tests of attention over a cache as one kernel on GPUs: values, on the GPU, or else by Pallas' interpreter."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.layers.attention import KeyValues, attend_cached
from rsjax.layers.gpu.cached_attention import attend, fits
from rsjax.layers.kernel_flops import kernel_flops
from rsjax.layers.platform import attend_over_cache
from tests.layers.kernels import INTERPRETED, in_dtypes, lowered

SHAPE = (2, 2, 8, 3, 2, 32)
SLOTS = 16


def operands(shape: tuple[int, ...], slots: int, dtype: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    clips, _, cells, _, heads, width = shape
    qkv = 2 * jax.random.normal(jax.random.key(0), shape)
    cache = jax.random.normal(jax.random.key(1), (2, clips, cells, heads, slots, width))
    return qkv.astype(dtype), cache[0].astype(dtype), cache[1].astype(dtype)


CASES = [
    (SHAPE, SLOTS, 14, 16),  # the last frames of a window
    (SHAPE, SLOTS, 0, 16),  # nothing in the cache
    (SHAPE, SLOTS, 21, 6),  # slots used again, older than the window
    ((1, 2, 3, 3, 6, 16), 8, 5, 1),  # each frame sees itself alone; numbers that are no powers of two
    ((1, 1, 64, 3, 1, 64), 8, 3, 8),  # several programs along cells
    ((1, 1, 2, 3, 4, 128), 32, 30, 32),  # and along heads
]


@pytest.mark.parametrize(("shape", "slots", "start", "window", "dtype", "bound"), in_dtypes(CASES, 2e-6))
def test_values_are_those_of_plain_attention(
    shape: tuple[int, ...], slots: int, start: int, window: int, dtype: Any, bound: float
) -> None:
    assert fits(shape, slots)
    qkv, keys, values = operands(shape, slots, dtype)
    out = attend(qkv, keys, values, start, window, interpret=INTERPRETED)
    assert out.dtype == dtype
    exact = [x.astype(jnp.float32) for x in (qkv, keys, values)]
    truth = attend_cached(exact[0], KeyValues(*exact[1:]), start, window)
    largest = float(jnp.max(jnp.abs(truth)))
    np.testing.assert_allclose(out.astype(jnp.float32) / largest, truth / largest, atol=bound)


def test_clips_at_different_positions_are_attended_to_as_each_alone() -> None:
    qkv, keys, values = (x[:, None] for x in operands(SHAPE, SLOTS, jnp.float32))
    starts = jnp.array([3, 9])

    def run(qkv: Any, keys: Any, values: Any, start: Any) -> Any:
        return attend(qkv, keys, values, start, 16, interpret=INTERPRETED)

    both = jax.jit(jax.vmap(run))(qkv, keys, values, starts)
    for i, start in enumerate(starts):
        np.testing.assert_array_equal(both[i], run(qkv[i], keys[i], values[i], start))


@pytest.mark.parametrize(
    ("shape", "slots"),
    [
        ((1, 3, 8, 3, 2, 32), 16),  # as many frames as a prompt may have
        ((1, 1, 8, 3, 2, 24), 16),
        (SHAPE, 17),  # rotary positions
        (SHAPE, 256),
    ],
)
def test_other_shapes_do_not_fit(shape: tuple[int, ...], slots: int) -> None:
    assert not fits(shape, slots)


@pytest.mark.parametrize(("dtype", "has_kernel"), [(jnp.bfloat16, {"cuda"}), (jnp.float32, set())])
def test_programs_for_gpus_alone_have_the_kernel_and_for_a_bf16_cache_alone(dtype: Any, has_kernel: set[str]) -> None:
    qkv, keys, values = operands(SHAPE, SLOTS, jnp.bfloat16)
    cache = KeyValues(keys.astype(dtype), values.astype(dtype))
    run = partial(attend_over_cache, window=16)
    texts = {name: lowered(run, (qkv, cache, 3), name) for name in ("cpu", "cuda", "tpu")}
    assert {name for name, text in texts.items() if "attend_cache" in text} == has_kernel


def test_operations_count_the_new_frames_up_to_a_query_s_own() -> None:
    count = kernel_flops("attend_cache", [SHAPE, (2, 8, 2, SLOTS, 32)], [])
    assert count == 2 * 2 * (2 * 8 * 2) * (SLOTS + 1 + SLOTS + 2) * 32
