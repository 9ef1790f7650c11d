"""ΔPSNR: the loss of PSNR when a clip is generated under actions that are not its own (Genie, Bruce et al. 2024).

Both videos start from the same prompt with the same sampling key, and both are compared with the truth. Published
numbers average over three or more draws of random actions.
"""

import numpy as np
from jaxtyping import Float, Int, Num

from rsjax.clip import Array
from rsjax.evaluation.metrics.psnr import psnr
from rsjax.evaluation.registry import Need, PerFrame, Scene, Scores, metric
from rsjax.evaluation.statistics import over_predicted_frames

GENIE_T = 4  # the predicted frame that Genie reports


def _register(name: str, title: str, kind: Need) -> None:
    """Registers ΔPSNR for one kind of random actions: the mean over frames, and Δ₄ as ``_t4``."""

    def per_frame(scene: Scene) -> PerFrame:
        return scene.shared(_draws, kind).mean(0)[:, scene.prompt_frames :]

    @metric(name, title, unit="dB", better="higher", decimals=2, needs=(kind,), per_frame=per_frame)
    def score(scene: Scene) -> Scores:
        means = clip_means(scene.shared(_draws, kind), scene.prompt_frames)
        return {"" if part == "mean" else f"_{part}": per_clip for part, per_clip in means.items()}


def _draws(scene: Scene, kind: Need) -> Float[np.ndarray, "R B T"]:
    draws = scene.alternatives[kind]
    return np.stack([delta_psnr(scene.truth.rgb, scene.prediction.rgb, drawn.rgb) for drawn in draws])


def delta_psnr(
    truth: Num[Array, "*B T H W C"],
    own_actions: Num[Array, "*B T H W C"],
    random_actions: Num[Array, "*B T H W C"],
) -> Float[np.ndarray, "*B T"]:
    """Returns Δ_t of every frame in dB: PSNR(truth, under its own actions) - PSNR(truth, under random actions)."""
    return np.asarray(psnr(truth, own_actions) - psnr(truth, random_actions))


def clip_means(delta: Float[np.ndarray, "R B T"], prompt_frames: int = 1) -> dict[str, Float[np.ndarray, " B"]]:
    """Returns each clip's ΔPSNR in dB, averaged over R draws of random actions.

    Returns:
        "mean": over all predicted frames; "t4": Δ₄, that of the fourth predicted frame, absent if there are fewer.
    """
    draws_mean = np.asarray(delta).mean(0)
    means = {"mean": over_predicted_frames(draws_mean, prompt_frames)}
    fourth = prompt_frames + GENIE_T - 1
    if fourth < draws_mean.shape[-1]:
        means["t4"] = draws_mean[:, fourth]
    return means


def action_range(actions: Float[np.ndarray, "N T A"]) -> tuple[Float[np.ndarray, " A"], Float[np.ndarray, " A"]]:
    """Returns the 1st and 99th percentile of each action dimension over clips.

    Row 0 of each clip is left out, since no action led into the first frame.
    """
    low, high = np.percentile(actions[:, 1:].reshape(-1, actions.shape[-1]), [1, 99], axis=0)
    return low + 0.0, high + 0.0  # no -0.0, which numpy refuses as the end of a range that begins at 0.0


def uniform_actions(
    actions: Float[np.ndarray, "B T A"],
    low: Float[np.ndarray, " A"],
    high: Float[np.ndarray, " A"],
    draws: int,
    seed: int,
) -> Float[np.ndarray, "R B T A"]:
    """Draws actions uniformly between ``low`` and ``high`` in each dimension, independently at each frame.

    Row 0 stays the clip's own. All arguments must be in the same units.
    """
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(low, high, (draws, *actions.shape)).astype(actions.dtype)
    drawn[:, :, 0] = actions[:, 0]
    return drawn


def other_clips(clips: int, draws: int, seed: int) -> Int[np.ndarray, "R B"]:
    """Draws for each clip another clip, whose actions it gets, by permutations without fixed points.

    Raises:
        ValueError: fewer than two clips.
    """
    if clips < 2:
        raise ValueError(f"another clip's actions need at least 2 clips to evaluate, not {clips}; raise eval.clips")
    rng = np.random.default_rng(seed)
    permutations: list[Int[np.ndarray, " B"]] = []
    while len(permutations) < draws:  # by rejection, which takes about e tries for any number of clips
        permutation = rng.permutation(clips)
        if (permutation != np.arange(clips)).all():
            permutations.append(permutation)
    return np.stack(permutations)


_register("delta_psnr", "ΔPSNR, another clip's actions", "other")
_register("delta_psnr_uniform", "ΔPSNR, uniform actions", "uniform")
