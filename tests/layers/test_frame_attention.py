from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.layers import accelerator
from rsjax.layers.attention import attend
from rsjax.layers.cpu import frame_attention
from rsjax.layers.cpu.frame_attention import attend_in_frames
from rsjax.layers.platform import attend_cells
from rsjax.models.roboscape.architecture import Architecture
from rsjax.models.roboscape.transformer import Transformer


@pytest.mark.parametrize(("bf16", "tolerance"), [(True, 0.02), (False, 2e-6)])
@pytest.mark.parametrize(("causal", "long"), [(False, 8), (True, 8), (True, 100)])  # long: cells cut into blocks
def test_output_and_gradients_are_plain_attention_s_to_rounding(
    monkeypatch: pytest.MonkeyPatch, causal: bool, long: int, bf16: bool, tolerance: float
) -> None:
    monkeypatch.setattr(frame_attention, "LONG", long)
    monkeypatch.setattr("rsjax.runtime.has_bf16_units", lambda: bf16)
    keys = jax.random.split(jax.random.key(0), 4)
    q, k, v, cotangent = (jax.random.normal(key, (3, 10, 2, 8)) for key in keys)  # N S h e
    found, pull = jax.vjp(jax.jit(lambda *x: attend_in_frames(*x, causal)), q, k, v)
    mask = jnp.tri(10, dtype=bool) if causal else None
    plain, pull_plain = jax.vjp(lambda q, k, v: attend(q, k, v, mask), q, k, v)
    for x, y in zip((found, *pull(cotangent)), (plain, *pull_plain(cotangent)), strict=True):
        assert x.dtype == jnp.float32 and x.shape == y.shape
        np.testing.assert_allclose(x, y, atol=tolerance * float(jnp.max(jnp.abs(y))))


@pytest.mark.parametrize("causal", [False, True])
def test_on_an_accelerator_it_is_plain_attention_to_bf16_rounding(causal: bool) -> None:
    keys = jax.random.split(jax.random.key(3), 3)
    q, k, v = (jax.random.normal(key, (2, 6, 2, 8)) for key in keys)  # N S h e
    plain = attend_cells(q, k, v, bf16=False, causal=causal)
    found = accelerator.attend(q, k, v, causal)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, plain, atol=0.02)


@pytest.mark.parametrize("unrolled", [1, 2])  # frame by frame; two at a time, and one is left over
def test_how_far_the_loop_is_unrolled_changes_nothing(monkeypatch: pytest.MonkeyPatch, unrolled: int) -> None:
    q, k, v, cotangent = (jax.random.normal(key, (3, 6, 2, 4)) for key in jax.random.split(jax.random.key(2), 4))
    out, pull = jax.vjp(attend_in_frames, q, k, v)
    gradients = pull(cotangent)
    monkeypatch.setattr(frame_attention, "UNROLLED", unrolled)
    other, pull = jax.vjp(attend_in_frames, q, k, v)
    for x, y in zip((other, *pull(cotangent)), (out, *gradients), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-6, atol=1e-6)


def test_a_rematerialised_model_of_large_frames_learns_as_with_plain_attention(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = Architecture(
        frames=2,
        grid=3,
        code_bits=4,
        action_inputs=3,
        width=16,
        blocks=2,
        heads=2,
        compute_dtype="bfloat16",
        remat="blocks",
    )
    tokens = {name: jax.random.randint(jax.random.key(3), (1, 2, 3, 3), 0, 16) for name in ("rgb", "depth")}
    mask, actions = jnp.zeros((1, 2, 3, 3), bool), jnp.ones((1, 2, 3))
    params = jax.jit(Transformer(cfg).init_params)(jax.random.key(4))

    def loss(params: Any) -> jax.Array:
        logits, _ = Transformer(cfg).apply({"params": params}, tokens, mask, actions)  # type: ignore[misc]
        return sum((jnp.mean(jnp.sin(x)) for x in logits.values()), start=jnp.float32(0))

    plain = jax.jit(jax.grad(loss))(params)
    monkeypatch.setattr(frame_attention, "LARGE_FRAME", 1)
    for x, y in zip(jax.tree.leaves(jax.jit(jax.grad(loss))(params)), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(x, y, atol=0.03 * float(jnp.max(jnp.abs(y))) + 1e-6)
