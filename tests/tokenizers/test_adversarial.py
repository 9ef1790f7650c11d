from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import AdversarialConfig
from rsjax.tokenizers.adversarial import adversarial_terms, initial_averages, updated_averages
from rsjax.tokenizers.discriminator import MIN_SIZE, Discriminator

CONFIG = AdversarialConfig(lecam_decay=0.9)
AVERAGES = {"real": jnp.float32(0.7), "fake": jnp.float32(-0.4)}


@pytest.fixture(scope="module")
def inputs() -> tuple[Any, np.ndarray, np.ndarray]:
    """Discriminator, real images and fake ones."""
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda x: 3 * x, jax.jit(Discriminator().init_params)(jax.random.key(0)))
    target, output = (rng.uniform(-1, 1, (3, MIN_SIZE, MIN_SIZE, 3)).astype(np.float32) for _ in range(2))
    return params, target, output


@jax.jit
def means(params: Any, target: Any, output: Any, active: Any) -> dict[str, Any]:
    terms = adversarial_terms(CONFIG, params, target, output, active, AVERAGES, None)
    return {name: total / weight for name, (total, weight) in terms.items()}


def test_terms_are_the_published_formulas(inputs: Any) -> None:
    params, target, output = inputs
    logits = jax.jit(lambda x: Discriminator().apply({"params": params}, x))
    real, fake = np.asarray(logits(target)), np.asarray(logits(output))
    anchor_real, anchor_fake = 0.9 * 0.7 + 0.1 * real.mean(), 0.9 * -0.4 + 0.1 * fake.mean()
    expected = {
        "adversarial": np.mean(np.log1p(np.exp(-fake.mean((1, 2))))),
        "hinge": np.maximum(0, 1 - real).mean() + np.maximum(0, 1 + fake).mean(),
        "lecam": (np.maximum(0, real - anchor_fake) ** 2).mean() + (np.maximum(0, anchor_real - fake) ** 2).mean(),
        "real_logit": real.mean(),
        "fake_logit": fake.mean(),
    }
    found = means(params, target, output, jnp.float32(1))
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-4, atol=1e-5, err_msg=name)


def test_each_side_moves_only_itself_and_logits_move_neither(inputs: Any) -> None:
    params, target, output = inputs
    gradients = jax.jit(jax.jacrev(means, argnums=(0, 2)))(params, target, output, jnp.float32(1))
    moves = {
        name: tuple(any(np.any(leaf != 0) for leaf in jax.tree.leaves(by)) for by in both)
        for name, both in gradients.items()
    }
    assert moves == {
        "adversarial": (False, True),
        "hinge": (True, False),
        "lecam": (True, False),
        "real_logit": (False, False),
        "fake_logit": (False, False),
    }


def test_before_its_start_only_the_logits_are_watched(inputs: Any) -> None:
    found = means(*inputs, jnp.float32(0))
    assert {name for name, value in found.items() if value != 0} == {"real_logit", "fake_logit"}


def test_averages_forget_slowly() -> None:
    averages = initial_averages()
    for _ in range(3):
        averages = updated_averages(averages, jnp.float32(2), jnp.float32(-1), 0.9)
    np.testing.assert_allclose([averages["real"], averages["fake"]], (1 - 0.9**3) * np.array([2, -1]), rtol=1e-5)
