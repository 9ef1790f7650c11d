"""The samplers against ``diffusers``, where it is installed, and by what a network that knows the answer leads to."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rsjax.config import ConfigError
from rsjax.models.diffusion.config import DenoiseConfig, NoiseConfig
from rsjax.models.diffusion.samplers import denoise, sampler_coefficients
from rsjax.models.diffusion.schedule import add_noise, alphas, target

LEFT = alphas(NoiseConfig())
SIGNAL, SPREAD = (jnp.asarray(np.sqrt(x), jnp.float32) for x in (LEFT, 1 - LEFT))


def network(x: Any, t: Any) -> Any:
    """About the noise in data of unit variance, so that latents stay of order 1 from step to step."""
    return SPREAD[t] * x + 0.2 * x / (1 + x * x)


@pytest.mark.parametrize(
    ("sampler", "spacing", "prediction", "betas"),
    [
        ("ddim", "linspace", "noise", "linear"),
        ("ddim", "trailing", "velocity", "scaled_linear"),
        ("ddim", "leading", "noise", "linear"),
        ("pndm", "linspace", "noise", "linear"),
        ("pndm", "trailing", "velocity", "linear"),
        ("pndm", "leading", "noise", "scaled_linear"),
    ],
)
def test_latents_are_those_of_diffusers(sampler: Any, spacing: Any, prediction: Any, betas: Any) -> None:
    torch, diffusers = pytest.importorskip("torch"), pytest.importorskip("diffusers")
    settings = {
        "beta_start": 1e-4,
        "beta_end": 0.02,
        "beta_schedule": betas,
        "timestep_spacing": spacing,
        "prediction_type": {"noise": "epsilon", "velocity": "v_prediction"}[prediction],
        "set_alpha_to_one": sampler == "ddim",
    }
    kind = diffusers.PNDMScheduler if sampler == "pndm" else diffusers.DDIMScheduler
    scheduler = kind(**settings, **({} if sampler == "pndm" else {"clip_sample": False}))
    scheduler.set_timesteps(20)
    start = np.random.default_rng(0).normal(size=(2, 5)).astype(np.float32)
    x = torch.from_numpy(start)
    for t in scheduler.timesteps:
        x = scheduler.step(torch.from_numpy(np.array(network(x.numpy(), int(t)))), t, x).prev_sample

    sample = DenoiseConfig(sampler, steps=20, spacing=spacing, end_clean=sampler == "ddim")
    plan = sampler_coefficients(NoiseConfig(betas=betas, prediction=prediction), sample)
    np.testing.assert_array_equal(plan.t, scheduler.timesteps)
    np.testing.assert_allclose(denoise(plan, network, jnp.asarray(start)), x.numpy(), atol=1e-5)


@pytest.mark.parametrize("prediction", ["noise", "velocity"])
def test_a_network_that_knows_the_clean_latents_leads_ddim_to_them(prediction: Any) -> None:
    noise = NoiseConfig(prediction=prediction)
    clean, start = jax.random.normal(jax.random.key(0), (2, 3, 4))

    def knows(x: Any, t: Any) -> Any:
        drawn = (x - SIGNAL[t] * clean) / SPREAD[t]
        return target(noise, clean, drawn, jnp.full(len(x), t))

    plan = sampler_coefficients(noise, DenoiseConfig("ddim", steps=12, end_clean=True))
    np.testing.assert_allclose(denoise(plan, knows, start), clean, atol=1e-4)


def test_pndm_makes_fewer_errors_than_ddim() -> None:
    """In Gaussian data the best network is known, and so is where it leads: latents keep their rank."""
    deviation, start = 0.5, jnp.array([[-1.5, 0.3, 2.0]])

    def best(x: Any, t: Any) -> Any:
        return x * SPREAD[t] / (SIGNAL[t] ** 2 * deviation**2 + SPREAD[t] ** 2)

    exact = deviation * start / jnp.sqrt(deviation**2 * SIGNAL[-1] ** 2 + SPREAD[-1] ** 2)
    errors = {
        sampler: float(
            jnp.abs(denoise(sampler_coefficients(NoiseConfig(), DenoiseConfig(sampler)), best, start) - exact).max()
        )  # type: ignore[arg-type]
        for sampler in ("ddim", "pndm")
    }
    assert errors["pndm"] < errors["ddim"] / 2
    assert errors["pndm"] < 0.02


def test_network_calls_are_the_steps_and_nine_more_for_pndm() -> None:
    assert len(sampler_coefficients(NoiseConfig(), DenoiseConfig("ddim")).t) == 50
    assert len(sampler_coefficients(NoiseConfig(), DenoiseConfig("pndm")).t) == 59


def test_known_latents_stay_as_they_are_and_are_what_the_network_sees() -> None:
    known = jnp.arange(3.0)

    def restore(x: Any) -> Any:
        return x.at[:, 0].set(known)

    def predict(x: Any, t: Any) -> Any:
        return jnp.broadcast_to(jnp.where(jnp.all(x[:, 0] == known), 0.0, jnp.nan), x.shape)

    made = denoise(sampler_coefficients(NoiseConfig(), DenoiseConfig(steps=5)), predict, jnp.ones((2, 4, 3)), restore)
    np.testing.assert_array_equal(made[:, 0], np.broadcast_to(known, (2, 3)))
    assert np.isfinite(made).all()


@pytest.mark.parametrize("prediction", ["noise", "velocity"])
def test_noisy_latents_and_the_target_determine_the_clean_ones(prediction: Any) -> None:
    noise, t = NoiseConfig(prediction=prediction), jnp.array([0, 500])
    clean, drawn = jax.random.normal(jax.random.key(0), (2, 2, 4))
    noisy, wanted = add_noise(noise, clean, drawn, t), target(noise, clean, drawn, t)
    signal, spread = SIGNAL[t][:, None], SPREAD[t][:, None]
    back = (noisy - spread * wanted) / signal if prediction == "noise" else signal * noisy - spread * wanted
    np.testing.assert_allclose(back, clean, atol=1e-4)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"sampler": "pndm", "steps": 3}, "model.sample.steps is 3; the sampler pndm takes at least 4"),
        ({"steps": 0, "sampler": "ddim"}, "model.sample.steps is 0"),
    ],
)
def test_impossible_samplers_are_refused(settings: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        DenoiseConfig(**settings)


def test_a_sampler_of_more_steps_than_the_forward_process_is_refused() -> None:
    with pytest.raises(ConfigError, match="model.sample.steps is 50 of model.noise.steps 20"):
        DenoiseConfig().check(NoiseConfig(steps=20))
