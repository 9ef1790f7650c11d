"""Convolutions as bf16 products are XLA's convolutions of the rounded operands, in both passes."""

from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.layers.convolution import Conv, conv
from rsjax.layers.cpu import convolution
from rsjax.layers.cpu.convolution import conv_bf16
from rsjax.layers.platform import convolve


def rounded(x: Any) -> jax.Array:
    return jnp.asarray(x, jnp.bfloat16).astype(jnp.float32)


def plain(x: jax.Array, kernel: jax.Array) -> jax.Array:
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


@settings(max_examples=6)
@given(
    size=st.sampled_from([1, 3, 5]),
    shape=st.tuples(st.integers(1, 2), st.integers(1, 5), st.integers(1, 5), st.integers(1, 4)),
    outputs=st.integers(1, 4),
    strip=st.sampled_from([1, 24, 2**21]),  # row by row; several rows or images at a time; all at once
    wide=st.sampled_from([1, 128]),  # a product for each row of the kernel; one for all rows
)
def test_output_and_gradients_are_those_of_the_rounded_operands(
    size: int, shape: tuple[int, int, int, int], outputs: int, strip: int, wide: int
) -> None:
    rng = np.random.default_rng(0)
    x, kernel, cotangent = (
        rounded(rng.normal(size=each)) for each in (shape, (size, size, shape[-1], outputs), (*shape[:-1], outputs))
    )
    with mock.patch.multiple(convolution, STRIP=strip, WIDE=wide):
        out, pull = jax.vjp(conv_bf16, x, kernel)
        gradients = pull(cotangent)
    expected, pull_plain = jax.vjp(plain, x, kernel)
    for found, wanted in zip((out, *gradients), (expected, *pull_plain(cotangent)), strict=True):
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.usefixtures("bf16_units")
@pytest.mark.parametrize("kernel", [1, 3])
def test_a_layer_of_many_channels_takes_products_and_keeps_its_parameters(
    monkeypatch: pytest.MonkeyPatch, kernel: int
) -> None:
    monkeypatch.setattr(convolution, "LEAST", 4)
    x = jax.random.normal(jax.random.key(0), (2, 6, 6, 4))
    exact, half = conv(5, kernel, "float32"), conv(5, kernel, "bfloat16")
    variables = exact.init(jax.random.key(1), x)
    jax.tree.map(np.testing.assert_array_equal, variables, half.init(jax.random.key(1), x))

    def passes(layer: Conv) -> tuple[Any, Any]:
        def total(variables: Any, x: Any) -> Any:
            out: Any = layer.apply(variables, x)
            return jnp.sin(out).sum()

        return jax.value_and_grad(total, argnums=(0, 1))(variables, x)

    for found, wanted in zip(jax.tree.leaves(passes(half)), jax.tree.leaves(passes(exact)), strict=True):
        difference = float(jnp.max(jnp.abs(found - wanted)))
        assert found.dtype == jnp.float32
        assert 0 < difference < 0.03 * max(1.0, float(jnp.max(jnp.abs(wanted))))


@pytest.mark.usefixtures("bf16_units")
@pytest.mark.parametrize(
    "settings",
    [{"rhs_dilation": (2, 2)}, {"lhs_dilation": (2, 2)}, {"feature_group_count": 2}, {"window_strides": (2, 2)}, {}],
)
def test_whatever_its_settings_it_is_the_convolution_of_jax(
    monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any]
) -> None:
    monkeypatch.setattr(convolution, "LEAST", 1)
    x = jax.random.normal(jax.random.key(0), (1, 6, 6, 4))
    kernel = jax.random.normal(jax.random.key(1), (3, 3, 4 // settings.get("feature_group_count", 1), 4))
    whole = {"window_strides": (1, 1), "padding": ((1, 1), (1, 1)), "dimension_numbers": ("NHWC", "HWIO", "NHWC")}
    expected = jax.lax.conv_general_dilated(x, kernel, **(whole | settings))
    np.testing.assert_allclose(convolve(x, kernel, **(whole | settings)), expected, atol=0.1)


@pytest.mark.usefixtures("bf16_units")
@pytest.mark.parametrize("settings", [{"kernel": 3, "stride": 2, "padding": ((1, 1), (1, 1))}, {"kernel": 2}])
def test_what_changes_the_size_or_has_an_even_kernel_stays_exact(
    monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any]
) -> None:
    monkeypatch.setattr(convolution, "LEAST", 1)
    x = jax.random.normal(jax.random.key(0), (1, 6, 6, 4))
    exact, half = conv(5, dtype="float32", **settings), conv(5, dtype="bfloat16", **settings)
    variables = exact.init(jax.random.key(1), x)
    np.testing.assert_array_equal(exact.apply(variables, x), half.apply(variables, x))


def test_a_processor_without_bf16_units_convolves_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(convolution, "LEAST", 1)
    monkeypatch.setattr("rsjax.runtime.has_bf16_units", lambda: False)
    x = jax.random.normal(jax.random.key(0), (1, 6, 6, 4))
    exact, half = conv(5, 3, "float32"), conv(5, 3, "bfloat16")
    variables = exact.init(jax.random.key(1), x)
    np.testing.assert_array_equal(exact.apply(variables, x), half.apply(variables, x))
