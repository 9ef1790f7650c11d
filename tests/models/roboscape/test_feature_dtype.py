"""Features in bf16 between layers: close to float32, used on accelerators alone."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rsjax.models.roboscape.transformer import Transformer, run_transformer
from tests.layers.kernels import lowered
from tests.models.roboscape.toy import DUAL, random_inputs, random_params

WIDE = replace(DUAL, width=32, compute_dtype="bfloat16")
NARROW = replace(WIDE, feature_dtype="bfloat16")


def test_logits_and_gradients_are_those_of_float32_to_rounding() -> None:
    # At their full size, attention is so sharp that rounding decides the gradients on some processors.
    params = jax.tree.map(lambda x: 0.5 * x, random_params(WIDE))
    arguments = random_inputs(WIDE)

    def loss(arch: Any, params: Any) -> Any:
        logits, _ = Transformer(arch).apply({"params": params}, *arguments)
        return sum(jnp.mean(jnp.square(x)) for x in logits.values())

    values = [jax.jit(jax.value_and_grad(partial(loss, arch)))(params) for arch in (WIDE, NARROW)]
    (expected, gradients), (found, other_gradients) = values
    np.testing.assert_allclose(found, expected, rtol=0.02)
    assert found != expected
    for x, y in zip(jax.tree.leaves(other_gradients), jax.tree.leaves(gradients), strict=True):
        assert x.dtype == jnp.float32
        np.testing.assert_allclose(x, y, atol=0.05 * float(jnp.max(jnp.abs(y))) + 1e-6)


def test_a_program_for_a_gpu_has_features_in_bf16() -> None:
    run = partial(run_transformer, WIDE)
    operands = random_params(WIDE), *random_inputs(WIDE)
    clips, frames = random_inputs(WIDE)[1].shape[:2]
    features = f"tensor<{clips}x{frames}x{WIDE.grid**2}x{WIDE.width}xbf16>"
    program = lowered(run, operands, "cuda")
    assert features in program
    assert features not in lowered(run, operands, "cpu")
    logits = f"tensor<{clips * frames * WIDE.grid**2}x{WIDE.vocabularies * WIDE.vocabulary_size}x"
    assert f"{logits}f32>" in program and f"{logits}bf16>" not in program
