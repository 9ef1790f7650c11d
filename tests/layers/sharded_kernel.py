"""Runs a kernel over two devices; tests/layers/test_partition.py starts it where there are two.

XLA_FLAGS=--xla_force_host_platform_device_count=2 python -m tests.layers.sharded_kernel
"""

import json
from contextlib import nullcontext
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from rsjax.layers.gpu.attention import attend
from rsjax.layers.gpu.mlp import mlp
from rsjax.layers.platform import attend_in_clip, for_all_platforms


def loss(qkv: Array) -> Array:
    out = attend(qkv, "cells", interpret=True)
    x = out.reshape(*out.shape[:3], -1)
    fc1 = (jnp.full((128, 64), 0.01), jnp.zeros(64))
    fc2 = (jnp.full((64, 128), 0.01), jnp.zeros(128))
    return jnp.sum(mlp(x, (jnp.full(128, 2.0), jnp.ones(128)), fc1, fc2, interpret=True) ** 2)


def tpu_kernels(mesh: Mesh | None) -> int:
    """Returns the number of kernels in attention lowered for TPUs, traced under this mesh."""
    run = jax.jit(partial(attend_in_clip, over="cells", bf16=True))
    qkv = jax.ShapeDtypeStruct((2, 1, 128, 3, 4, 32), jnp.bfloat16)
    with for_all_platforms(), nullcontext() if mesh is None else jax.set_mesh(mesh):
        return str(run.trace(qkv).lower(lowering_platforms=("tpu",)).as_text()).count("tpu_custom_call")


def main() -> None:
    qkv = jax.random.normal(jax.random.key(0), (4, 4, 64, 3, 8, 16))
    truth = jax.grad(loss)(qkv)
    mesh = Mesh(np.array(jax.devices()), ("data",), axis_types=(AxisType.Auto,))
    clips = NamedSharding(mesh, PartitionSpec("data"))
    sharded = jax.jit(jax.grad(loss)).lower(jax.device_put(qkv, clips)).compile()
    gradient = sharded(jax.device_put(qkv, clips))
    by_pmap = jax.pmap(jax.grad(loss))(qkv.reshape(2, 2, *qkv.shape[1:])).reshape(qkv.shape)
    with jax.set_mesh(mesh):
        on_set_mesh = jax.jit(jax.grad(loss)).lower(jax.device_put(qkv, clips)).compile()
    figures = {
        "gathers": sum(str(program.as_text()).count("all-gather") for program in (sharded, on_set_mesh)),
        "sharded": gradient.sharding.is_equivalent_to(clips, gradient.ndim),
        "mesh": float(jnp.max(jnp.abs(gradient - truth))),
        "set mesh": float(jnp.max(jnp.abs(on_set_mesh(jax.device_put(qkv, clips)) - truth))),
        "pmap": float(jnp.max(jnp.abs(by_pmap - truth))),
        "tpu kernels": [tpu_kernels(None), tpu_kernels(mesh)],
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
