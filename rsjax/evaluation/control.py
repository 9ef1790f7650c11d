"""ΔPSNR: how much worse a clip is predicted when the actions are not its own (Genie, Bruce et al. 2024).

Generate twice from the same first frame with the same sampling key, once with the clip's actions and once with random
ones, several draws of them (three or more for a published number), and compare both with the truth.
"""

import numpy as np
from jaxtyping import Float, Int, Num

from rsjax.clip import Array
from rsjax.evaluation.pixels import psnr
from rsjax.evaluation.statistics import over_predicted_frames

GENIE_T = 4  # Genie reports the fourth predicted frame


def delta_psnr(
    truth: Num[Array, "*B T H W C"],
    own_actions: Num[Array, "*B T H W C"],
    random_actions: Num[Array, "*B T H W C"],
) -> Float[np.ndarray, "*B T"]:
    """Δ_t in dB of every frame: PSNR(truth, under its own actions) - PSNR(truth, under random actions)."""
    return np.asarray(psnr(truth, own_actions) - psnr(truth, random_actions))


def clip_means(delta: Float[np.ndarray, "R B T"], prompt_frames: int = 1) -> dict[str, Float[np.ndarray, " B"]]:
    """Each clip's ΔPSNR in dB, averaged over R draws of random actions.

    Returns:
        "mean": over all predicted frames (the given ones are left out); "t4": Δ_4, the fourth predicted frame.
        "t4" is absent from clips with fewer than four predicted frames.
    """
    draws_mean = np.asarray(delta).mean(0)
    means = {"mean": over_predicted_frames(draws_mean, prompt_frames)}
    fourth = prompt_frames + GENIE_T - 1
    if fourth < draws_mean.shape[-1]:
        means["t4"] = draws_mean[:, fourth]
    return means


def action_range(actions: Float[np.ndarray, "N T A"]) -> tuple[Float[np.ndarray, " A"], Float[np.ndarray, " A"]]:
    """The 1st and 99th percentile of each action dimension over the training clips.

    Row 0 of a clip is left out: nothing led into the first frame.
    """
    low, high = np.percentile(actions[:, 1:].reshape(-1, actions.shape[-1]), [1, 99], axis=0)
    return low, high


def uniform_actions(
    actions: Float[np.ndarray, "B T A"],
    low: Float[np.ndarray, " A"],
    high: Float[np.ndarray, " A"],
    draws: int,
    seed: int,
) -> Float[np.ndarray, "R B T A"]:
    """Actions drawn uniformly within ``low`` … ``high`` of each dimension, independently at each frame.

    Row 0 stays the clip's own. Work in the space that the model is fed (raw or normalised) throughout.
    """
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(low, high, (draws, *actions.shape)).astype(actions.dtype)
    drawn[:, :, 0] = actions[:, 0]
    return drawn


def other_clips(clips: int, draws: int, seed: int) -> Int[np.ndarray, "R B"]:
    """Whose actions each clip gets: per draw a random permutation that leaves no clip its own.

    Raises:
        ValueError: fewer than two clips.
    """
    if clips < 2:
        raise ValueError(f"another clip's actions need at least 2 clips to evaluate, not {clips}; raise eval.clips")
    rng = np.random.default_rng(seed)
    return np.stack([_derangement(clips, rng) for _ in range(draws)])


def _derangement(n: int, rng: np.random.Generator) -> Int[np.ndarray, " n"]:
    """Uniform over the permutations without a fixed point, by rejection: about e tries whatever n is."""
    while True:
        permutation = rng.permutation(n)
        if (permutation != np.arange(n)).all():
            return permutation
