"""Means over clips and seeds with their intervals, tests of differences, and verdicts on claims."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.special import ndtri, stdtr, stdtrit

Statistic = Literal["mean", "median"]
Direction = Literal["higher", "lower"]
Verdict = Literal["holds", "does not hold", "equal", "cannot tell"]


_SUMMARIES: dict[Statistic, Callable[..., Any]] = {"mean": np.mean, "median": np.median}


@dataclass(frozen=True)
class Estimate:
    """A mean or median over clips with its bootstrap interval; ``low`` and ``high`` are None for a single clip."""

    value: float
    low: float | None
    high: float | None

    def flat(self, name: str) -> dict[str, float]:
        """Returns the value as ``name``, and the interval, if any, as ``name_low`` and ``name_high``."""
        values = {name: self.value, f"{name}_low": self.low, f"{name}_high": self.high}
        return {key: value for key, value in values.items() if value is not None}


def over_predicted_frames(per_frame: Float[np.ndarray, "*B T"], prompt_frames: int = 1) -> Float[np.ndarray, "*B"]:
    """Returns each clip's mean over its predicted frames, which are those after the first ``prompt_frames``.

    Raises:
        ValueError: there is no predicted frame.
    """
    per_frame = np.asarray(per_frame)
    if per_frame.shape[-1] <= prompt_frames:
        raise ValueError(f"{prompt_frames} of {per_frame.shape[-1]} frames are given; none is left to score")
    return per_frame[..., prompt_frames:].mean(-1)


def bootstrap(
    per_clip: Float[np.ndarray, " B"],
    seed: int = 0,
    level: float = 0.95,
    resamples: int = 10_000,
    statistic: Statistic = "mean",
) -> Estimate:
    """Returns the mean or median over clips and its percentile-bootstrap interval; clips are resampled, not frames.

    For a paired comparison of two models, pass the clips' differences.

    Args:
        per_clip: one finite number per clip.
        seed: of the resampling.
        level: the interval's coverage, between 0 and 1.
        resamples: the number of times that B clips are drawn with replacement.
        statistic: how the clips are summarised.

    Raises:
        ValueError: there are no clips, or a value is not finite.
    """
    values = np.asarray(per_clip, np.float64)
    if values.ndim != 1 or not values.size or not np.isfinite(values).all():
        raise ValueError(f"an interval needs one finite number per clip, not {values}")
    if len(values) == 1:
        return Estimate(float(values[0]), None, None)
    resampled = _resampled(values[None], seed, resamples, statistic)
    return _estimate(_SUMMARIES[statistic](values), resampled[:, 0], level)


def _resampled(
    scores: Float[np.ndarray, "S B"], seed: int, resamples: int, statistic: Statistic
) -> Float[np.ndarray, "R S"]:
    """Returns each seed's mean or median over the clips of each resample; all seeds share the resamples."""
    clips = scores.shape[1]
    if statistic == "mean":
        return _share_of_clips(clips, resamples, seed) @ scores.T
    drawn = np.random.default_rng(seed).integers(clips, size=(resamples, clips))
    return np.stack([np.median(each[drawn], axis=1) for each in scores], axis=1)


@lru_cache(maxsize=2)  # one entry for scores, one for the points of curves
def _share_of_clips(clips: int, resamples: int, seed: int) -> Float[np.ndarray, "R B"]:
    """Returns how often each clip was drawn in each resample, as shares that add up to 1."""
    drawn = np.random.default_rng(seed).integers(clips, size=(resamples, clips))
    cells = (drawn + clips * np.arange(resamples)[:, None]).ravel()
    return np.bincount(cells, minlength=clips * resamples).reshape(resamples, clips) / clips


def paired_bootstrap(
    a: Float[np.ndarray, "S B"],
    b: Float[np.ndarray, "Z B"],
    seed: int = 0,
    level: float = 0.95,
    resamples: int = 10_000,
    statistic: Statistic = "mean",
) -> Estimate:
    """Returns the score of a minus that of b, and its percentile-bootstrap interval over seeds and clips.

    A score is the mean over seeds of each seed's mean or median over clips. Each resample draws S seeds of ``a``, Z
    seeds of ``b`` and B clips; all seeds share the drawn clips, so clips stay paired. With one seed each, the interval
    says nothing about other seeds, and for means it is :func:`bootstrap` of the clips' differences. Two or three seeds
    understate how much seeds vary, so read :func:`welch` as well.

    Args:
        a, b: one number per seed and clip; the same clips in the same order. For one seed, its axis may be left out.
        seed, level, resamples, statistic: as in :func:`bootstrap`.

    Raises:
        ValueError: a and b differ in their number of clips, one is empty, or a value is not finite.
    """
    a, b = (np.atleast_2d(np.asarray(each, np.float64)) for each in (a, b))
    if a.shape[1:] != b.shape[1:] or not a.size or not b.size or not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError(f"a paired interval needs a finite number per seed and clip, not {a.shape} and {b.shape}")
    if a.shape[1] == 1:
        return Estimate(float(a.mean() - b.mean()), None, None)
    rng = np.random.default_rng([seed, 1])  # draws seeds only, not clips
    summarise = _SUMMARIES[statistic]

    def over_seeds(scores: Float[np.ndarray, "S B"]) -> Float[np.ndarray, " R"]:
        by_seed = _resampled(scores, seed, resamples, statistic)
        return (_share_of_seeds(len(scores), resamples, rng) * by_seed).sum(1)

    value = summarise(a, axis=1).mean() - summarise(b, axis=1).mean()
    return _estimate(value, over_seeds(a) - over_seeds(b), level)


def _share_of_seeds(seeds: int, resamples: int, rng: np.random.Generator) -> Float[np.ndarray, "R S"]:
    """Returns how often each seed was drawn in each resample, as shares that add up to 1."""
    drawn = rng.integers(seeds, size=(resamples, seeds))
    return (drawn[:, :, None] == np.arange(seeds)).mean(1)


def _estimate(value: float, resampled: Float[np.ndarray, " R"], level: float) -> Estimate:
    low, high = np.quantile(resampled, [(1 - level) / 2, (1 + level) / 2])
    return Estimate(float(value), float(low), float(high))


def nested_bootstrap(
    a: Sequence[Float[np.ndarray, " _"]],
    b: Sequence[Float[np.ndarray, " _"]],
    seed: int = 0,
    level: float = 0.95,
    resamples: int = 10_000,
    statistic: Statistic = "mean",
) -> Estimate:
    """Returns the score of a minus that of b, and its interval, where every seed has clips of its own.

    A score is the mean over seeds of each seed's mean or median over clips. Seeds are paired, since both trained and
    were scored on the same clips: each resample draws clips of every seed, as many as it has, and then S of the seeds.

    Args:
        a, b: for each of S seeds, one finite number per clip; the same seeds and clips in the same order.
        seed, level, resamples, statistic: as in :func:`bootstrap`.

    Raises:
        ValueError: a and b differ in their seeds or clips, or a value is not finite.
    """
    if not a or len(a) != len(b) or any(len(one) != len(other) for one, other in zip(a, b, strict=True)):
        raise ValueError(f"a nested interval needs the same seeds and clips, not {len(a)} and {len(b)} seeds")
    summarise = _SUMMARIES[statistic]
    value = float(np.mean([summarise(one) - summarise(other) for one, other in zip(a, b, strict=True)]))
    if max(map(len, a)) == 1:
        return Estimate(value, None, None)
    by_seed = []
    for number, pair in enumerate(zip(a, b, strict=True)):
        one, other = (np.asarray(each, np.float64)[None] for each in pair)
        if not (np.isfinite(one).all() and np.isfinite(other).all()):
            raise ValueError("a nested interval needs a finite number per seed and clip")
        key = seed + number  # both arms share the drawn clips
        by_seed.append(_resampled(one, key, resamples, statistic) - _resampled(other, key, resamples, statistic))
    differences = np.concatenate(by_seed, axis=1)
    shares = _share_of_seeds(len(a), resamples, np.random.default_rng([seed, 1]))
    return _estimate(value, (shares * differences).sum(1), level)


@dataclass(frozen=True)
class TTest:
    """A t-test of the difference of two means, and its interval.

    Attributes:
        difference: the mean of a minus the mean of b, with its t interval.
        t: the statistic; ±inf where nothing varies and the means differ.
        df: degrees of freedom.
        p: the two-sided p-value.
        error: the standard error of the difference.
    """

    difference: Estimate
    t: float
    df: float
    p: float
    error: float

    def p_of(self, value: float) -> float:
        """Returns the two-sided p-value of the hypothesis that the difference is this value."""
        distance = abs(self.difference.value - value)
        if not self.error:
            return float(distance == 0)
        return float(2 * stdtr(self.df, -distance / self.error))

    def p_beyond(self, margin: float) -> float:
        """Returns the p-value of the hypothesis that the difference is at least as large as a margin, either way.

        It is the larger of two one-sided tests (Schuirmann, 1987). Where it is small, the two are equal within the
        margin.
        """
        room = margin - abs(self.difference.value)  # to the nearer bound, which has the larger p-value
        if not self.error:
            return float(room <= 0)
        return float(stdtr(self.df, -room / self.error))


def welch(a: Float[np.ndarray, " S"], b: Float[np.ndarray, " Z"], level: float = 0.95) -> TTest | None:
    """Tests by Welch's t-test whether the means of two groups of seeds differ; their variances may differ.

    Returns None if a group has fewer than two seeds.

    Args:
        a, b: one number per seed, such as a run's mean over clips.
    """
    a = np.asarray(a, np.float64)
    b = np.asarray(b, np.float64)
    if min(len(a), len(b)) < 2:
        return None
    parts = (a.var(ddof=1) / len(a), b.var(ddof=1) / len(b))
    error = float(np.sqrt(sum(parts)))
    df = len(a) + len(b) - 2.0
    if error:
        df = float(error**4 / (parts[0] ** 2 / (len(a) - 1) + parts[1] ** 2 / (len(b) - 1)))
    return _t_test(float(a.mean() - b.mean()), error, df, level)


def paired_t(a: Float[np.ndarray, " S"], b: Float[np.ndarray, " S"], level: float = 0.95) -> TTest | None:
    """Tests whether the mean of the seeds' differences is 0, for seeds that share what varies among them, as clips.

    Returns None with fewer than two seeds.

    Args:
        a, b: one number per seed; the same seeds in the same order.
    """
    differences = np.asarray(a, np.float64) - np.asarray(b, np.float64)
    if len(differences) < 2:
        return None
    error = float(differences.std(ddof=1) / np.sqrt(len(differences)))
    return _t_test(float(differences.mean()), error, len(differences) - 1.0, level)


def _t_test(difference: float, error: float, df: float, level: float) -> TTest:
    """Returns the test of a difference with this standard error; without any error, only equality has p = 1."""
    half = float(stdtrit(df, (1 + level) / 2)) * error
    interval = Estimate(difference, difference - half, difference + half)
    if error:
        t = difference / error
    elif difference:
        t = float(np.copysign(np.inf, difference))
    else:
        t = 0.0
    return TTest(interval, t, df, float(2 * stdtr(df, -abs(t))), error)


def holm(p: ArrayLike) -> Float[np.ndarray, " M"]:
    """Returns the p-values of M tests adjusted by Holm's method, in the order given.

    If a test is rejected where its adjusted p-value is below a level, then the probability that any true hypothesis of
    the M is rejected is below this level, however the tests depend on one another (Holm, 1979).
    """
    values = np.asarray(p, np.float64)
    order = np.argsort(values, kind="stable")
    scaled = values[order] * np.arange(len(values), 0, -1)
    adjusted = np.empty_like(values)
    adjusted[order] = np.minimum(1, np.maximum.accumulate(scaled))
    return adjusted


def wilson(successes: int, trials: int, level: float = 0.95) -> Estimate:
    """Returns a share and Wilson's score interval, which stays within [0, 1] and is valid for few trials too.

    Raises:
        ValueError: there is no trial, or 0 ≤ successes ≤ trials does not hold.
    """
    if not 0 <= successes <= trials or not trials:
        raise ValueError(f"{successes} successes of {trials} trials have no share")
    return score_interval(successes / trials, trials, level)


def score_interval(share: float, trials: float, level: float = 0.95) -> Estimate:
    """Returns a share with Wilson's score interval for a number of trials, which need not be whole."""
    z = float(ndtri((1 + level) / 2))
    centre = share + z**2 / (2 * trials)
    scale = 1 + z**2 / trials
    half = z * np.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    return Estimate(share, float(max(0, (centre - half) / scale)), float(min(1, (centre + half) / scale)))


def share_difference(one: ArrayLike, other: ArrayLike, level: float = 0.95) -> Estimate:
    """Returns the difference of two shares of successes, one - other, with Newcombe's interval from Wilson's.

    Unlike a bootstrap interval, it has a positive width even if all trials ended alike. It assumes that the two are
    independent, so it is too wide, rather than too narrow, for trials that are paired by their start.

    Args:
        one: 1 for each success and 0 for each failure, of any shape.
        other: the same for the second share.
        level: the interval's coverage.

    Raises:
        ValueError: one of them is empty.
    """
    a, b = (wilson(int(np.sum(x)), np.size(x), level) for x in (one, other))
    assert a.low is not None and a.high is not None and b.low is not None and b.high is not None
    below = np.hypot(a.value - a.low, b.high - b.value)
    above = np.hypot(a.high - a.value, b.value - b.low)
    gap = a.value - b.value
    return Estimate(gap, float(gap - below), float(gap + above))


def can_lose(success: ArrayLike, margin: float) -> bool:
    """Returns whether trials succeed often enough to show a loss of ``margin``: Wilson's interval lies above it.

    Where no trial succeeds, nothing can be worse by a margin, so the claim "as good as this" would always hold.
    """
    low = wilson(int(np.sum(success)), np.size(success)).low
    return margin <= 0 or (low is not None and low > margin)


def verdict(interval: Estimate | None, direction: Direction = "higher", margin: float = 0.0) -> Verdict:
    """Judges the claim that a is better than b by more than a margin, from the interval of the difference a - b.

    Args:
        interval: of the difference; if it or one of its bounds is missing, the verdict is "cannot tell".
        direction: whether higher or lower values are better.
        margin: in the unit of the difference; a negative one claims that a is worse by less than ``-margin``.

    Returns:
        "holds" if the whole interval is above the margin, "does not hold" if it is all below, else "cannot tell"; for
        ``direction`` "lower", the interval is that of b - a.
    """
    if interval is None or interval.low is None or interval.high is None:
        return "cannot tell"
    if direction == "higher":
        low = interval.low
        high = interval.high
    else:
        low = -interval.high
        high = -interval.low
    if low > margin:
        return "holds"
    if high < margin:
        return "does not hold"
    return "cannot tell"
