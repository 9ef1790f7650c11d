"""The forward process, x_t = √ᾱ_t · x + √(1 - ᾱ_t) · noise, and the network's target.

Axes: B clips; latents have any number of axes, the first over clips.
"""

from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int

from rsjax.models.diffusion.config import NoiseConfig

Latents: TypeAlias = Float[Array, "*N"]


def alphas(noise: NoiseConfig) -> Float64[np.ndarray, " steps"]:
    """Returns ᾱ_t, the remaining share of the signal's power after step t; it falls, to 0 with ``zero_terminal``."""
    if noise.betas == "linear":
        betas = np.linspace(noise.beta_start, noise.beta_end, noise.steps)
    else:
        betas = np.linspace(noise.beta_start**0.5, noise.beta_end**0.5, noise.steps) ** 2
    left = np.cumprod(1.0 - betas)
    left = left / (noise.snr_shift + (1 - noise.snr_shift) * left)
    if not noise.zero_terminal:
        return left
    signal = np.sqrt(left)  # https://arxiv.org/abs/2305.08891, algorithm 1
    return np.square((signal - signal[-1]) * signal[0] / (signal[0] - signal[-1]))


def scales(noise: NoiseConfig, t: Int[Array, " B"], axes: int) -> tuple[Latents, Latents]:
    """Returns √ᾱ_t and √(1 - ᾱ_t), with ``axes`` axes: all after the first have length 1."""
    left = alphas(noise)
    shape = (-1, *(1,) * (axes - 1))
    signal, spread = (jnp.asarray(np.sqrt(x), jnp.float32)[t].reshape(shape) for x in (left, 1 - left))
    return signal, spread


def add_noise(noise: NoiseConfig, latents: Latents, drawn: Latents, t: Int[Array, " B"]) -> Latents:
    """Returns x_t for the drawn noise of unit variance."""
    signal, spread = scales(noise, t, latents.ndim)
    return signal * latents + spread * drawn


def target(noise: NoiseConfig, latents: Latents, drawn: Latents, t: Int[Array, " B"]) -> Latents:
    """Returns the network's training target: the noise, or the velocity √ᾱ·noise - √(1-ᾱ)·x."""
    if noise.prediction == "noise":
        return drawn
    signal, spread = scales(noise, t, latents.ndim)
    return signal * drawn - spread * latents
