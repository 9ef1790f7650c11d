"""CogVideoX is timed beside ``diffusers``, with networks of the same size."""

import jax
import pytest

from rsjax.models.base import create_autoencoder, create_model
from rsjax.tools.bench.run import bench
from tests.benchmarks.pytorch.eager import EAGER
from tests.models.cogvideox import toy

pytest.importorskip("torch")
pytest.importorskip("diffusers")


def test_all_parts_of_networks_of_the_same_size_are_timed_in_both_types() -> None:
    config = toy.config(mlp_ratio=4)
    numbers = bench(config, only=["tokenizer", "sample"], horizons=(8,), budget=0.0, rival=EAGER)
    shapes = jax.eval_shape(create_model(config).init, jax.random.key(0))
    del shapes["task_tokens"]
    networks = create_autoencoder(config).shapes()
    del networks["latents"]
    assert numbers["torch_parameters"] == sum(x.size for x in jax.tree.leaves((shapes, networks)))
    for dtype in ("float32", "bfloat16"):
        assert numbers[f"torch_train_step_s_{dtype}"] > 0
        for name in ("sample", "tokenizer_encode", "tokenizer_decode"):
            assert numbers[f"{name}_speedup_over_torch_{dtype}"] > 0
