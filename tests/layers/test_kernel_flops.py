"""The registered operations of kernels are those of the products that they are traced to."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from rsjax.layers.gpu import attention as gpu
from rsjax.layers.gpu.feed_forward import feed_forward
from rsjax.layers.gpu.mlp import mlp
from rsjax.layers.kernel_flops import kernel_flops
from rsjax.layers.tpu import attention as tpu
from rsjax.tokenizers.flops import products


def kernels(jaxpr: Any) -> list[Any]:
    """Returns the calls of kernels in a program."""
    found = [eqn for eqn in jaxpr.eqns if eqn.primitive.name == "pallas_call"]
    for eqn in jaxpr.eqns:
        if eqn.primitive.name != "pallas_call":
            for inner in jaxprs_in_params(eqn.params):
                found += kernels(inner)
    return found


def linear(inputs: int, outputs: int) -> tuple[jax.Array, jax.Array]:
    return jnp.zeros((inputs, outputs)), jnp.zeros(outputs)


ROWS = jnp.zeros((2, 2, 128, 64), jnp.bfloat16)
NORM = (jnp.zeros(64), jnp.zeros(64))
CALLS: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
    "attention over cells": (partial(gpu.attend, over="cells"), (jnp.zeros((2, 3, 256, 3, 2, 32), jnp.bfloat16),)),
    "attention over frames": (partial(gpu.attend, over="frames"), (jnp.zeros((2, 16, 8, 3, 2, 32), jnp.bfloat16),)),
    "over cells on a TPU": (partial(tpu.attend, over="cells"), (jnp.zeros((2, 3, 128, 3, 4, 32), jnp.bfloat16),)),
    "over frames on a TPU": (partial(tpu.attend, over="frames"), (jnp.zeros((2, 16, 16, 3, 4, 32), jnp.bfloat16),)),
    "mlp": (mlp, (ROWS, NORM, linear(64, 128), linear(128, 64))),
    "feed-forward": (feed_forward, (ROWS, linear(64, 256), linear(256, 64))),
}


@pytest.mark.parametrize("name", CALLS)
def test_the_count_is_that_of_the_kernel_s_own_products(name: str) -> None:
    run, operands = CALLS[name]

    def both_passes(*operands: Any) -> Any:
        out, pull = jax.vjp(run, *operands)
        return pull(out)

    calls = kernels(jax.make_jaxpr(both_passes)(*operands).jaxpr)
    assert len(calls) == 2
    for call in calls:
        done = products(call.params["jaxpr"]) * int(np.prod(call.params["grid_mapping"].grid))
        shapes = ([x.aval.shape for x in call.invars], [x.aval.shape for x in call.outvars])
        assert kernel_flops(call.params["name"], *shapes) == done > 0
