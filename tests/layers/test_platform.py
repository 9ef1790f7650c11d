"""Each function of the door: the platform of a program decides its code, and both implementations agree."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.layers import accelerator, platform
from rsjax.layers.cpu.matmul import matmul_bf16
from rsjax.layers.dense import Dense, rounded
from tests.layers.kernels import lowered

CONVOLUTION = {"window_strides": (1, 1), "padding": "SAME", "dimension_numbers": ("NHWC", "HWIO", "NHWC")}


def numbers(*shape: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(0).normal(size=shape), jnp.float32)


DOORS: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
    "matmul": (platform.linear, (numbers(6, 32), numbers(32, 4))),
    "attend_cells": (lambda x: platform.attend_cells(x, x, x, bf16=True), (numbers(1, 128, 2, 8),)),
    "convolve": (lambda x, w: platform.convolve(x, w, **CONVOLUTION), (numbers(1, 6, 6, 32), numbers(3, 3, 32, 32))),  # type: ignore[arg-type]
    "convolve_video": (
        lambda x, w: platform.convolve_video(x, w, bf16=True),
        (numbers(1, 4, 6, 6, 32), numbers(3, 3, 3, 32, 32)),
    ),
}


@pytest.mark.usefixtures("bf16_units")
@pytest.mark.parametrize("name", DOORS)
def test_a_program_for_a_gpu_or_tpu_is_the_same_wherever_it_is_lowered_and_not_the_cpu_s(name: str) -> None:
    run, operands = DOORS[name]
    programs = {target: lowered(run, operands, target) for target in ("cpu", "cuda", "tpu")}
    assert programs["cuda"] == programs["tpu"] != programs["cpu"]


@pytest.mark.usefixtures("bf16_units")
@pytest.mark.parametrize("name", DOORS)
def test_a_process_with_cpus_alone_traces_their_branch_alone(name: str) -> None:
    if {device.platform for device in jax.devices()} != {"cpu"}:
        pytest.skip("there are other devices")
    run, operands = DOORS[name]
    compiled = jax.jit(run)
    alone = jax.make_jaxpr(run)(*operands)
    found = compiled(*operands)
    with platform.for_all_platforms():
        both = jax.make_jaxpr(run)(*operands)
        expected = compiled(*operands)
    assert "platform_index" in str(both)
    assert "platform_index" not in str(alone)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.usefixtures("bf16_units")
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_both_products_have_the_same_values_gradients_and_number_formats(dtype: Any) -> None:
    operands = (numbers(6, 32).astype(dtype), numbers(32, 4))
    found, pull = jax.vjp(matmul_bf16, *operands)
    expected, other_pull = jax.vjp(lambda x, w: accelerator.linear(x, w, None), *operands)
    cotangent = numbers(6, 4).astype(dtype)
    for x, y in zip((found, *pull(cotangent)), (expected, *other_pull(cotangent)), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x.astype(jnp.float32), y.astype(jnp.float32), rtol=0.01, atol=0.01)


@pytest.mark.usefixtures("bf16_units")
def test_weights_that_are_rounded_once_give_what_layers_that_round_them_give() -> None:
    x = numbers(5, 8).astype(jnp.bfloat16)
    layer = Dense(4, bf16=True)
    params = layer.init(jax.random.key(0), x)["params"] | {"bias": numbers(4)}
    tree = {"fc": params, "norm": {"scale": numbers(3), "bias": numbers(3)}}
    once = rounded(tree)
    np.testing.assert_array_equal(
        layer.apply({"params": once["fc"]}, x),  # type: ignore[arg-type]
        layer.apply({"params": params}, x),  # type: ignore[arg-type]
    )
    assert once["norm"] is tree["norm"]


def test_on_accelerators_biases_that_are_rounded_once_change_nothing_for_bf16_features() -> None:
    x = numbers(5, 8).astype(jnp.bfloat16)
    tree = {
        "block": {
            "proj": {"kernel": numbers(8, 4), "bias": numbers(4)},
            "fc1": {"kernel": numbers(4, 3), "bias": numbers(3)},
        }
    }
    once = rounded(tree, biases=("proj",))["block"]["proj"]
    assert {array.dtype for array in once.values()} == {jnp.dtype(jnp.bfloat16)}
    assert rounded(tree, biases=("proj",))["block"]["fc1"]["bias"].dtype == jnp.float32
    each_time = tree["block"]["proj"]
    np.testing.assert_array_equal(
        accelerator.linear(x, once["kernel"], once["bias"]),
        accelerator.linear(x, each_time["kernel"], each_time["bias"]),
    )
