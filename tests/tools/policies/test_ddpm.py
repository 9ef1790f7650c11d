import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.tools.policies.ddpm import add_noise, cosine_schedule, sample


def test_the_schedule_is_the_squared_cosine() -> None:
    left = cosine_schedule(100)

    def f(share: float) -> float:
        return np.cos((share + 0.008) / 1.008 * np.pi / 2) ** 2

    for step in (0, 1, 50, 98):
        assert left[step] == pytest.approx(f((step + 1) / 100) / f(0))
    assert left[99] == pytest.approx(left[98] * 0.001)  # β is at most 0.999


def test_noise_is_added_as_if_step_by_step() -> None:
    """The mean and variance of N small steps, √(1-β) x + √β ε each, are those of one jump."""
    left = cosine_schedule(10)
    betas = 1 - left / np.concatenate([[1], left[:-1]])
    mean, variance = 1.0, 0.0
    for step, beta in enumerate(betas):
        mean, variance = np.sqrt(1 - beta) * mean, (1 - beta) * variance + beta
        one, zero, at = jnp.ones((1, 1)), jnp.zeros((1, 1)), jnp.array([step])
        assert add_noise(one, zero, at, left)[0, 0] == pytest.approx(mean, rel=1e-5)
        assert add_noise(zero, one, at, left)[0, 0] == pytest.approx(np.sqrt(variance), rel=1e-5)


def test_sampling_equals_a_loop_of_ddpm() -> None:
    """Against the posterior of Ho et al. Eq. 6 and 7, written with β of the steps that are taken, 4 of 12."""
    steps = 4
    left = cosine_schedule(12)
    key = jax.random.key(3)
    shape = (2, 4, 3)
    weights = np.random.default_rng(0).normal(size=(3, 3))

    def predict(x: jax.Array, step: jax.Array) -> jax.Array:
        return jnp.tanh(x @ jnp.asarray(weights, jnp.float32) + 0.1 * step[:, None, None])

    first, rest = jax.random.split(key)
    x = np.asarray(jax.random.normal(first, shape), np.float64)
    places = list(range(0, 12, 12 // steps))
    bars = {-1: 1.0} | {number: left[place] for number, place in enumerate(places)}
    for number in reversed(range(steps)):
        bar, before = bars[number], bars[number - 1]
        beta = 1 - bar / before
        noise = np.tanh(x @ weights + 0.1 * places[number])
        clean = np.clip((x - np.sqrt(1 - bar) * noise) / np.sqrt(bar), -1, 1)
        mean = (np.sqrt(before) * beta * clean + np.sqrt(1 - beta) * (1 - before) * x) / (1 - bar)
        drawn = np.asarray(jax.random.normal(jax.random.fold_in(rest, places[number]), shape))
        x = mean + (np.sqrt((1 - before) / (1 - bar) * beta) * drawn if number else 0)
    np.testing.assert_allclose(sample(predict, key, shape, left, steps), x, atol=2e-4)
