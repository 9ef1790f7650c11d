"""Denoising diffusion (DDPM, Ho et al. 2020) with the squared-cosine schedule, predicting the noise ε.

Axes: B samples, N noise steps.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int, Key

MOST_BETA = 0.999


def cosine_schedule(steps: int) -> Float64[np.ndarray, " N"]:
    """Returns ᾱ after each noise step, the remaining share of the signal's variance (Nichol & Dhariwal 2021)."""
    places = np.arange(steps + 1) / steps
    left = np.cos((places + 0.008) / 1.008 * np.pi / 2) ** 2
    betas = np.minimum(1 - left[1:] / left[:-1], MOST_BETA)
    return np.cumprod(1 - betas)


def add_noise(
    clean: Float[Array, "B ..."], noise: Float[Array, "B ..."], step: Int[Array, " B"], left: Float64[np.ndarray, " N"]
) -> Float[Array, "B ..."]:
    """Returns the samples with the noise of their step, √ᾱ x + √(1-ᾱ) ε; ``step`` counts from 0."""
    share = jnp.asarray(left, jnp.float32)[step].reshape(-1, *[1] * (clean.ndim - 1))
    return jnp.sqrt(share) * clean + jnp.sqrt(1 - share) * noise


def sample(
    predict: Callable[[Float[Array, "B ..."], Int[Array, " B"]], Float[Array, "B ..."]],
    key: Key[Array, ""],
    shape: tuple[int, ...],
    left: Float64[np.ndarray, " N"],
    steps: int,
) -> Float[Array, "B ..."]:
    """Draws samples in [-1, 1].

    Args:
        predict: predicts the noise in a sample at a noise step.
        key: determines all draws.
        shape: the shape of the samples, with B first.
        left: ᾱ of each noise step.
        steps: how many of the noise steps to take, evenly spaced; DDPM itself takes all of them.
    """
    first, rest = jax.random.split(key)
    stride = len(left) // steps
    places = np.arange(steps)[::-1] * stride
    now = left[places]
    before = np.where(places >= stride, left[places - stride], 1.0)
    keep = now / before
    rows = {
        "place": places.astype(np.int32),
        "signal": 1 / np.sqrt(now),
        "noise": np.sqrt(1 - now) / np.sqrt(now),
        "clean": np.sqrt(before) * (1 - keep) / (1 - now),
        "same": np.sqrt(keep) * (1 - before) / (1 - now),
        "spread": np.sqrt((1 - before) / (1 - now) * (1 - keep)),  # 0 in the last step
    }
    inputs = {name: jnp.asarray(row, jnp.int32 if name == "place" else jnp.float32) for name, row in rows.items()}

    def denoise(x: Array, row: dict[str, Array]) -> tuple[Array, None]:
        step = jnp.full(shape[0], row["place"])
        clean = jnp.clip(row["signal"] * x - row["noise"] * predict(x, step), -1, 1)
        drawn = jax.random.normal(jax.random.fold_in(rest, row["place"]), shape)
        return row["clean"] * clean + row["same"] * x + row["spread"] * drawn, None

    return jax.lax.scan(denoise, jax.random.normal(first, shape), inputs)[0]
