import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rsjax.tokenizers import lfq

FACTORISATIONS = [(18, 1), (18, 3), (10, 5)]


def tokens_of(code_bits: int) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(np.int32, (2, 3), elements=st.integers(0, 2**code_bits - 1))


def test_a_latent_of_zero_is_a_cleared_bit() -> None:
    np.testing.assert_array_equal(lfq.quantize(jnp.array([0.0, 1e-9, -1e-9])), [-1, 1, -1])
    assert int(lfq.codes_to_tokens(jnp.array([0.0, 1e-9, -1e-9]))) == 2


@settings(deadline=None)  # the first example compiles
@given(tokens_of(18))
def test_codes_spell_their_tokens(tokens: np.ndarray) -> None:
    codes = lfq.tokens_to_codes(jnp.array(tokens), 18)
    np.testing.assert_array_equal(lfq.codes_to_tokens(codes), tokens)
    spelt = sum((np.asarray(codes[..., c]) > 0) * 2**c for c in range(18))
    np.testing.assert_array_equal(spelt, tokens)
    assert set(np.unique(codes)) <= {-1.0, 1.0}


@pytest.mark.parametrize(("code_bits", "vocabularies"), FACTORISATIONS)
def test_sub_tokens_are_the_digits_of_a_token(code_bits: int, vocabularies: int) -> None:
    size = 2 ** (code_bits // vocabularies)

    @settings(deadline=None, max_examples=30)
    @given(tokens_of(code_bits))
    def check(tokens: np.ndarray) -> None:
        split = lfq.split_tokens(jnp.array(tokens), code_bits, vocabularies)
        for k in range(vocabularies):
            np.testing.assert_array_equal(split[..., k], (tokens // size**k) % size)
        np.testing.assert_array_equal(lfq.merge_tokens(split, code_bits), tokens)

    check()


@settings(deadline=None)  # the first example compiles
@given(tokens_of(18))
def test_vocabularies_hold_consecutive_channels(tokens: np.ndarray) -> None:
    split = np.asarray(lfq.split_tokens(jnp.array(tokens), 18, 2))
    table = np.asarray(lfq.vocabulary_codes(18, 2))
    assert table.shape == (512, 9)
    codes = np.concatenate([table[split[..., 0]], table[split[..., 1]]], axis=-1)
    np.testing.assert_array_equal(codes, lfq.tokens_to_codes(jnp.array(tokens), 18))


def test_the_gradient_passes_straight_through_the_signs() -> None:
    latents = jnp.array([-3.0, -0.1, 0.2, 5.0])
    weights = jnp.array([1.0, -2.0, 3.0, 0.5])
    gradient = jax.grad(lambda x: jnp.sum(weights * lfq.quantize(x)))(latents)
    np.testing.assert_allclose(gradient, weights)


def test_commitment_draws_latents_to_their_codes() -> None:
    latents = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32)
    codes = np.where(latents > 0, 1, -1)
    loss, gradient = jax.value_and_grad(lfq.commitment_loss)(jnp.array(latents))
    np.testing.assert_allclose(loss, np.mean((latents - codes) ** 2), rtol=1e-6)
    np.testing.assert_allclose(gradient, 2 * (latents - codes) / latents.size, rtol=1e-5, atol=1e-7)


def entropy_over_all_codes(latents: np.ndarray, temperature: float, offset: float) -> float:
    """The reference: softmax over all codes, and log(p + offset) in the average's entropy only."""
    codes = np.array(list(itertools.product([-1.0, 1.0], repeat=latents.shape[-1])))
    affinity = 2 * latents.astype(np.float64) @ codes.T / temperature
    p = np.exp(affinity - affinity.max(-1, keepdims=True))
    p /= p.sum(-1, keepdims=True)

    def entropy(distribution: np.ndarray, offset: float = 0.0) -> float:
        positive = distribution[distribution > 0]
        return float(-np.sum(positive * np.log(positive + offset)))

    return float(np.mean([entropy(row) for row in p])) - entropy(p.mean(0), offset)


@pytest.mark.parametrize("code_bits", [1, 5])
@pytest.mark.parametrize(("scale", "temperature"), [(0.005, 0.01), (1.0, 0.01), (0.5, 1.0)])
@pytest.mark.parametrize("offset", [0.0, 1e-2])
def test_factorised_entropy_is_the_sum_over_all_codes(
    code_bits: int, scale: float, temperature: float, offset: float
) -> None:
    latents = np.random.default_rng(code_bits).normal(scale=scale, size=(6, 2, code_bits)).astype(np.float32)
    expected = entropy_over_all_codes(latents.reshape(-1, code_bits), temperature, offset)
    found = jax.jit(lfq.entropy_loss)(jnp.array(latents), temperature, offset)
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-5)


def test_the_entropy_of_the_average_is_that_of_all_devices_tokens() -> None:
    latents = (
        jax.random.normal(jax.random.key(0), (4, 6, 5)) * 0.01
    )  # four devices' parts, of which each uses few codes

    def on_each(latents: jax.Array) -> jax.Array:
        return lfq.entropy_loss(latents, 0.01, total=lambda x: jax.lax.psum(x, "devices"))

    whole = jax.jit(lfq.entropy_loss)(latents, 0.01)
    parts = jax.jit(jax.vmap(on_each, axis_name="devices"))(latents)
    apart = jax.jit(jax.vmap(lfq.entropy_loss, (0, None)))(latents, 0.01)
    np.testing.assert_allclose(np.mean(parts), whole, rtol=1e-5)
    assert abs(np.mean(apart) - whole) > 0.1


def test_at_18_bits_the_offset_changes_the_gradient() -> None:
    latents = jax.random.normal(jax.random.key(0), (64, 18))
    exact, reference = (np.ravel(jax.grad(lfq.entropy_loss)(latents, 0.01, offset)) for offset in (0.0, 1e-5))
    assert np.all(np.isfinite(exact)) and np.all(np.isfinite(reference))
    assert exact @ reference < 0, "for few tokens the gradients even point apart"
