"""Convolutions of transformed kernels are XLA's convolutions, up to the rounding of their operands to bf16."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.layers.convolution import conv
from rsjax.layers.cpu import winograd
from rsjax.layers.platform import with_transformed_kernels

CHANNELS = 32


def plain(x: jax.Array, kernel: jax.Array) -> jax.Array:
    axes = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=axes, precision="highest")


def layer(height: int, width: int, outputs: int) -> tuple[Any, Any, jax.Array]:
    x = jax.random.normal(jax.random.key(0), (3, height, width, CHANNELS))
    each = conv(outputs, 3, "bfloat16")
    return each, each.init(jax.random.key(1), x)["params"], x


def test_whole_numbers_are_convolved_exactly() -> None:
    """Sums of few small numbers, and halves of even ones, are exact in bf16."""
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.integers(-8, 9, (2, 6, 4, 3)), jnp.float32)
    kernel = jnp.asarray(2 * rng.integers(-2, 3, (3, 3, 3, 5)), jnp.float32)
    transformed = winograd.transformed_kernel(kernel)
    np.testing.assert_array_equal(winograd.convolve_transformed(x, transformed), plain(x, kernel))


@pytest.mark.usefixtures("bf16_units")
def test_a_layer_reads_the_transformed_kernel_and_rounds_little_more() -> None:
    each, params, x = layer(8, 6, CHANNELS)
    faster = with_transformed_kernels({"inner": params})["inner"]
    exact = plain(x, params["kernel"]) + params["bias"]
    direct = each.apply({"params": params}, x)
    out = each.apply({"params": faster}, x)
    assert set(faster) == {"kernel", "bias", "transformed"}
    assert 0 < jnp.std(out - exact) < 2 * jnp.std(direct - exact) < 0.01


@pytest.mark.usefixtures("bf16_units")
@pytest.mark.parametrize(("height", "width"), [(7, 6), (6, 7)])
def test_images_of_odd_sizes_are_convolved_as_before(height: int, width: int) -> None:
    each, params, x = layer(height, width, CHANNELS)
    out = each.apply({"params": with_transformed_kernels(params)}, x)
    np.testing.assert_array_equal(out, each.apply({"params": params}, x))


def test_images_whose_products_would_leave_the_cache_are_not_taken() -> None:
    kernel = jnp.zeros((16, 128, 128))
    assert winograd.takes(jnp.zeros((1, 64, 64, 128)), kernel)
    assert not winograd.takes(jnp.zeros((1, 256, 256, 128)), kernel)


@pytest.mark.usefixtures("bf16_units")
def test_other_kernels_stay_alone() -> None:
    narrow = {"kernel": jnp.zeros((3, 3, 18, 64))}
    small = {"kernel": jnp.zeros((1, 1, 64, 64))}
    norm = {"scale": jnp.zeros(64)}
    params = {"narrow": narrow, "small": small, "norm": norm}
    assert {name: set(inner) for name, inner in with_transformed_kernels(params).items()} == {
        "narrow": {"kernel"},
        "small": {"kernel"},
        "norm": {"scale"},
    }
    wide = {"kernel": jnp.zeros((3, 3, 64, 64))}
    assert "transformed" in with_transformed_kernels(wide)
