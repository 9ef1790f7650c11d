import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import numpy as np

from rsjax.layers.gpu.attention import attend

ROOT = Path(__file__).parents[2]


def test_every_device_runs_a_kernel_with_its_own_clips() -> None:
    environment = os.environ | {
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2",
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, "-m", "tests.layers.sharded_kernel"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["gathers"] == 0
    assert figures["sharded"]
    assert figures["tpu kernels"] == [0, 1]  # their compiler cannot divide a kernel without a mesh
    assert max(figures["mesh"], figures["set mesh"], figures["pmap"]) < 1e-5, figures


def test_a_kernel_that_is_mapped_over_gives_what_it_gives_alone() -> None:
    qkv = jax.random.normal(jax.random.key(0), (3, 2, 2, 16, 3, 1, 16))
    run = partial(attend, over="cells", interpret=True)

    def squares(qkv: jax.Array) -> jax.Array:
        return (run(qkv) ** 2).sum()

    for function in (run, jax.grad(squares)):
        alone = [function(each) for each in qkv]
        np.testing.assert_allclose(jax.vmap(function)(qkv), alone, atol=1e-6)
