"""DDIM and PNDM as tables of coefficients, and one loop that follows such a table.

Both move latents from step t to an earlier step t' by x' = keep · x + add · e, where e is a weighted sum of the
network's outputs (PNDM, https://arxiv.org/abs/2202.09778, eq. 9–12). If e is a single output, this is DDIM's step
without noise. All else follows ``diffusers``, such as t' = t - steps // sampled steps.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int

from rsjax.models.diffusion.config import DenoiseConfig, NoiseConfig
from rsjax.models.diffusion.schedule import Latents, alphas

PAST = 3  # outputs that PNDM remembers
RK_GROUPS = 3  # Runge-Kutta steps at the beginning of PNDM, of four calls each
MULTISTEP = np.array([55, -59, 37, -9]) / 24  # Adams-Bashforth: this output, then the remembered ones, newest first


class SamplerCoefficients(NamedTuple):
    """The coefficients of each network call, K calls in order.

    Attributes:
        t: step of the forward process, an input of the network.
        keep, add: coefficients of the latents and of e.
        restart: 1: moves the current latents; 0: moves the latents of the last call whose ``restart`` is 1.
        remember: 1 if the output joins the remembered outputs.
        weights: weights of this output and of the remembered ones in e.
        summed: weight of the running sum in e.
        share: weight of this output in the running sum, which ``restart`` sets back to zero.
    """

    t: Int[np.ndarray, " K"]
    keep: Float[np.ndarray, " K"]
    add: Float[np.ndarray, " K"]
    restart: Float[np.ndarray, " K"]
    remember: Float[np.ndarray, " K"]
    weights: Float[np.ndarray, "K 4"]
    summed: Float[np.ndarray, " K"]
    share: Float[np.ndarray, " K"]


def sampler_coefficients(noise: NoiseConfig, sample: DenoiseConfig) -> SamplerCoefficients:
    """Returns the sampler's table."""
    if sample.sampler == "pndm":
        return _pndm(noise, sample)
    t = timesteps(noise, sample)[::-1]
    keep, add = _moves(noise, sample, t, t - noise.steps // sample.steps)
    ones = np.ones(len(t))
    zeros = np.zeros(len(t))
    only_this = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    return SamplerCoefficients(t, keep, add, ones, zeros, only_this, zeros, zeros)


def timesteps(noise: NoiseConfig, sample: DenoiseConfig) -> Int[np.ndarray, " steps"]:
    """Returns the visited steps of the forward process, ascending."""
    every = noise.steps
    count = sample.steps
    if sample.spacing == "linspace":
        return np.linspace(0, every - 1, count).round().astype(np.int32)
    if sample.spacing == "leading":
        return np.arange(count, dtype=np.int32) * (every // count)
    return (np.round(np.arange(every, 0, -every / count))[:count].astype(np.int32) - 1)[::-1]


def _pndm(noise: NoiseConfig, sample: DenoiseConfig) -> SamplerCoefficients:
    """Three Runge-Kutta steps of four calls each, then linear multistep."""
    stride = noise.steps // sample.steps
    descending = timesteps(noise, sample)[::-1]
    half = stride // 2
    later = descending[RK_GROUPS:]
    pairs = list(pairwise(descending[: RK_GROUPS + 1]))
    t = np.concatenate([[s, r + half, r + half, r] for s, r in pairs] + [later])
    begin = np.concatenate([[s] * 4 for s, _ in pairs] + [later])
    end = np.concatenate([[s - half, r + half, r, r] for s, r in pairs] + [later - stride])
    keep, add = _moves(noise, sample, begin, end)

    def column(group: list[float], after: float) -> Float64[np.ndarray, " K"]:
        return np.array(group * RK_GROUPS + [after] * len(later))

    weights = np.stack([column([1, 1, 1, 1 / 6], MULTISTEP[0])] + [column([0] * 4, x) for x in MULTISTEP[1:]], axis=1)
    return SamplerCoefficients(
        t=t,
        keep=keep,
        add=add,
        restart=column([1, 0, 0, 0], 1),
        remember=column([1, 0, 0, 0], 1),
        weights=weights,
        summed=column([0, 0, 0, 1], 0),
        share=column([1 / 6, 1 / 3, 1 / 3, 0], 0),
    )


def _moves(
    noise: NoiseConfig, sample: DenoiseConfig, begin: Int[np.ndarray, " K"], end: Int[np.ndarray, " K"]
) -> tuple[Float64[np.ndarray, " K"], Float64[np.ndarray, " K"]]:
    """Returns ``keep`` and ``add`` of moves between steps; an end below 0 is the last move, to clean latents."""
    left = alphas(noise)
    last = left[0]
    if sample.end_clean:
        last = 1.0
    a = left[begin]
    b = np.where(end >= 0, left[end], last)
    if noise.prediction == "velocity":
        return np.sqrt(a * b) + np.sqrt((1 - a) * (1 - b)), np.sqrt(a * (1 - b)) - np.sqrt(b * (1 - a))
    return np.sqrt(b / a), -(b - a) / (a * np.sqrt(1 - b) + np.sqrt(a * (1 - a) * b))


def denoise(
    coefficients: SamplerCoefficients,
    predict: Callable[[Latents, Int[Array, ""]], Latents],
    start: Latents,
    restore: Callable[[Latents], Latents] = lambda x: x,
) -> Latents:
    """Returns the clean latents that the ``coefficients`` make from noise.

    Args:
        predict: the network, which maps noisy latents and their step to its output.
        start: noise of unit variance.
        restore: puts known latents back; called before the first network call and after each call.
    """

    def call(carry: tuple[Any, ...], row: Any) -> tuple[tuple[Any, ...], None]:
        x, begin, total, past = carry
        out = predict(x, row.t)
        begin = jnp.where(row.restart > 0, x, begin)
        e = row.weights[0] * out + jnp.tensordot(row.weights[1:], past, 1) + row.summed * total
        total = jnp.where(row.restart > 0, 0.0, total) + row.share * out
        past = jnp.where(row.remember > 0, jnp.concatenate([out[None], past[:-1]]), past)
        return (restore(row.keep * begin + row.add * e), begin, total, past), None

    rows = {name: jnp.asarray(x, jnp.float32) for name, x in coefficients._asdict().items()}
    rows["t"] = jnp.asarray(coefficients.t, jnp.int32)
    start = restore(start)
    carry = (start, start, jnp.zeros_like(start), jnp.zeros((PAST, *start.shape), start.dtype))
    return jax.lax.scan(call, carry, SamplerCoefficients(**rows))[0][0]  # type: ignore[arg-type]
