"""Judges claims by the scores of their arms, whether they are read from run directories or from a committed file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rsjax.evaluation import statistics
from rsjax.evaluation.registry import Metric, Unavailable, metrics
from rsjax.evaluation.statistics import Estimate, Statistic, TTest, Verdict
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.paper.arm_scores import ArmScores, read_arm
from rsjax.tools.studies.paper.claim import ArmComparison, Claim
from rsjax.tools.studies.paper.measurements import read_scores
from rsjax.tools.studies.paper.plan import Plan
from rsjax.tools.studies.results import read_run

SUCCESS = "success"  # the name of scores that are 1 or 0 for each trial; all trials may end alike
SIGNIFICANT = 0.05  # an adjusted p-value below it decides, if the interval agrees
LEVEL = 0.95  # of the intervals
EQUAL_LEVEL = 0.9  # of the interval that must lie within the margin of equality: two one-sided tests at 0.05

Rows = Sequence[Float[np.ndarray, " _"]]  # for each seed, one number per clip


@dataclass(frozen=True)
class Judged:
    """A comparison with its measurements and verdict.

    Attributes:
        comparison: what was claimed.
        metric: the metric of the comparison.
        seeds: the numbers of finished seeds of both arms.
        published: the paper's difference, if it has one.
        sides: both scores, means over seeds.
        difference: the arm claimed to be better minus the other, with the interval that decides: it contains the one
            from resampling and that of the t-test.
        resampled: the same with the interval from resampling seeds and clips.
        inner: the same with the 90 % interval that decides whether both are equal.
        test: the t-test over the seeds, Welch's or, if each seed has its own clips, a paired one; None with fewer than
            two seeds.
        clips: the number of clips that have a score in all seeds of both arms; of a seed with clips of its own.
        p: the p-value of the claimed margin, by Holm adjusted for the claim's comparisons.
        equal_p: the p-value of a difference beyond the margin of equality, likewise adjusted.
        verdict: "holds" and "does not hold" need the interval and p; "equal" needs the inner interval and equal_p.
        reason: why there is no difference, or why there is no verdict.
    """

    comparison: ArmComparison
    metric: Metric
    seeds: tuple[int, int]
    published: float | None = None
    sides: tuple[float, float] | None = None
    difference: Estimate | None = None
    resampled: Estimate | None = None
    inner: Estimate | None = None
    test: TTest | None = None
    clips: int = 0
    p: float | None = None
    equal_p: float | None = None
    verdict: Verdict = "cannot tell"
    reason: str = ""

    @property
    def shift(self) -> float:
        """The difference at the border of the claim: its margin, towards better values."""
        return self.comparison.margin if self.metric.better == "higher" else -self.comparison.margin


class PairedScores(NamedTuple):
    """The scores of two arms for the clips that both have.

    Attributes:
        a, b: of the arm claimed to be better and of the other, by seed.
        own_clips: whether each seed has clips of its own, so that seeds are paired.
    """

    a: Rows
    b: Rows
    own_clips: bool


@dataclass(frozen=True)
class Outcome:
    """A claim with all that was measured for it."""

    claim: Claim
    arms: tuple[ArmScores, ...]
    judged: tuple[Judged, ...]

    @property
    def counts(self) -> dict[Verdict, int]:
        """The number of comparisons with each verdict, among those that could be made."""
        counts: dict[Verdict, int] = {"holds": 0, "does not hold": 0, "equal": 0, "cannot tell": 0}
        for each in self.judged:
            if each.difference is not None:
                counts[each.verdict] += 1
        return counts

    @property
    def verdict(self) -> Verdict:
        """The verdict on the whole claim, from the comparisons that could be made.

        "holds" if all of them hold, "equal" if all are equal. "does not hold" if any does not hold, or if some are
        equal and nothing is open: where arms are equal, neither is better. Otherwise "cannot tell".
        """
        counts = self.counts
        made = sum(counts.values())
        for word in ("holds", "equal"):
            if made and counts[word] == made:
                return word
        if counts["does not hold"] or (counts["equal"] and not counts["cannot tell"]):
            return "does not hold"
        return "cannot tell"


def judge_all(plan: Plan, runs: Mapping[str, Run]) -> list[Outcome]:
    """Judges all claims of a plan by the cells that have finished so far.

    Args:
        runs: the run of each cell of the plan, by name.
    """
    results = {name: read_run(runs[name]) for name in plan.cells}
    read = cache(read_scores)  # claims share trainings
    return [
        judge_claim(claim, [read_arm(claim, arm.name, plan, results, read) for arm in claim.arms])
        for claim in plan.claims
    ]


def judge_claim(claim: Claim, arms: Sequence[ArmScores]) -> Outcome:
    """Judges a claim by its arms' scores; Holm's method adjusts the p-values of all its comparisons."""
    known = {arm.name: arm for arm in arms}
    measured = [_measure(claim, comparison, known) for comparison in claim.comparisons]
    tested = [each for each in measured if each.test is not None and not each.reason]
    margins = [each for each in tested if each.comparison.equal_margin]
    p = dict(zip(map(id, tested), statistics.holm([each.test.p_of(each.shift) for each in tested]), strict=True))  # type: ignore[union-attr]
    beyond = statistics.holm([each.test.p_beyond(each.comparison.equal_margin) for each in margins])  # type: ignore[union-attr]
    equal_p = dict(zip(map(id, margins), beyond, strict=True))
    judged = []
    for each in measured:
        if id(each) in p:
            adjusted = float(p[id(each)])
            beside = float(equal_p[id(each)]) if id(each) in equal_p else None
            each = replace(each, p=adjusted, equal_p=beside)
            each = replace(each, verdict=_verdict(each))
        judged.append(each)
    return Outcome(claim, tuple(arms), tuple(judged))


def _measure(claim: Claim, comparison: ArmComparison, arms: Mapping[str, ArmScores]) -> Judged:
    """Returns a comparison with its difference, intervals and test, without a verdict."""
    metric = metrics().get(comparison.metric) or Metric(comparison.metric, comparison.metric, "", "higher", 3)
    better = arms[comparison.better]
    than = arms[comparison.than]
    one, other = (claim.arm(name).published for name in (comparison.better, comparison.than))
    score = comparison.score or comparison.metric
    than_score = comparison.than_score or comparison.metric
    published = one[score] - other[than_score] if score in one and than_score in other else None
    judged = Judged(comparison, metric, (len(better.seeds), len(than.seeds)), published)
    try:
        pair = _paired(better, than, comparison)
    except Unavailable as reason:
        return replace(judged, reason=str(reason))
    if pair.own_clips:
        judged = replace(judged, seeds=(len(pair.a), len(pair.b)))
    summarise = np.mean if metric.statistic == "mean" else np.median
    a, b = (np.array([summarise(row) for row in rows]) for rows in (pair.a, pair.b))
    success = comparison.metric == SUCCESS
    resampled, inner = (_resampled(pair, level, metric.statistic, success) for level in (LEVEL, EQUAL_LEVEL))
    judged = replace(
        judged,
        sides=(float(a.mean()), float(b.mean())),
        difference=resampled,
        resampled=resampled,
        clips=min(map(len, pair.a)),
    )
    compare = statistics.paired_t if pair.own_clips else statistics.welch
    test = compare(a, b, LEVEL)
    inner_test = compare(a, b, EQUAL_LEVEL)
    if test is None or inner_test is None:
        return replace(judged, reason="one seed says nothing about others")
    judged = replace(judged, test=test, difference=_wider(resampled, test), inner=_wider(inner, inner_test))
    if success and not statistics.can_lose(trials(pair.b, pair.own_clips), -comparison.margin):
        return replace(judged, reason="the other side succeeds too seldom for a loss of the margin to show")
    return judged


def _verdict(judged: Judged) -> Verdict:
    verdict = statistics.verdict(judged.difference, judged.metric.better, judged.comparison.margin)
    if verdict != "cannot tell" and judged.p is not None and judged.p < SIGNIFICANT:
        return verdict
    inner = judged.inner
    margin = judged.comparison.equal_margin
    within = inner is not None and inner.low is not None and inner.high is not None
    if within and judged.equal_p is not None and judged.equal_p < SIGNIFICANT:
        assert inner is not None and inner.low is not None and inner.high is not None
        if -margin < inner.low and inner.high < margin:
            return "equal"
    return "cannot tell"


def _resampled(pair: PairedScores, level: float, statistic: Statistic, success: bool) -> Estimate:
    """Returns the difference with its interval over seeds and clips, or, for success rates, Newcombe's."""
    if success:
        sides = (trials(pair.a, pair.own_clips), trials(pair.b, pair.own_clips))
        return statistics.share_difference(*sides, level)
    if pair.own_clips:
        return statistics.nested_bootstrap(pair.a, pair.b, level=level, statistic=statistic)
    return statistics.paired_bootstrap(np.stack(pair.a), np.stack(pair.b), level=level, statistic=statistic)


def trials(rows: Rows, own_clips: bool) -> Float[np.ndarray, " _"]:
    """Returns the trials of all seeds; those of one seed if all have the same, as an arm does that no seed trains."""
    first = rows[0]
    if not own_clips and all(np.array_equal(first, row) for row in rows[1:]):
        return first
    return np.concatenate(rows)


def _paired(better: ArmScores, than: ArmScores, comparison: ArmComparison) -> PairedScores:
    """Returns both arms' scores by seed, for the clips that have a finite score in all seeds of both.

    If each seed has clips of its own, a clip needs a score in its seed of both, and seeds of one arm alone are left
    out.

    Raises:
        Unavailable: there is nothing to compare.
    """
    a = _scores(better, comparison.score or comparison.metric, comparison)
    b = _scores(than, comparison.than_score or comparison.metric, comparison)
    if better is not than and better.trainings == than.trainings:
        raise Unavailable("both arms are the same configuration in this preset")
    own_clips = len(set(better.clips)) > 1 or len(set(than.clips)) > 1
    if own_clips:
        other = dict(zip(than.seeds, than.clips, strict=True))
        common = [seed for seed, clips in zip(better.seeds, better.clips, strict=True) if other.get(seed) == clips]
        a = [a[better.seeds.index(seed)] for seed in common]
        b = [b[than.seeds.index(seed)] for seed in common]
        sizes = [(len(one), len(other)) for one, other in zip(a, b, strict=True)]
        different = next((pair for pair in sizes if pair[0] != pair[1]), None)
    else:
        for arm, rows in ((better, a), (than, b)):
            if len({len(row) for row in rows}) > 1:
                raise Unavailable(f"{arm.name}: its seeds were scored on different numbers of clips")
        different = None if len(a[0]) == len(b[0]) else (len(a[0]), len(b[0]))
    if different:
        raise Unavailable(f"scores of {different[0]} and {different[1]} clips cannot be paired")
    if own_clips:
        kept = [np.isfinite(one) & np.isfinite(other) for one, other in zip(a, b, strict=True)]
    else:
        kept = [np.isfinite(np.stack([*a, *b])).all(0)] * max(len(a), len(b))
    if not kept or not all(each.any() for each in kept):
        raise Unavailable("no clip has a score in all seeds of both")
    return PairedScores(
        [row[keep] for row, keep in zip(a, kept, strict=False)],
        [row[keep] for row, keep in zip(b, kept, strict=False)],
        own_clips,
    )


def _scores(arm: ArmScores, score: str, comparison: ArmComparison) -> Rows:
    """Returns an arm's scores by seed.

    Raises:
        Unavailable: no seed has finished, or a finished seed lacks this score.
    """
    if arm.absent or not arm.seeds:
        raise Unavailable(f"{arm.name}: {arm.absent or 'no seed has finished'}")
    scored = arm.scores[comparison.measurement][score]
    if scored.reason:
        raise Unavailable(f"{arm.name}: {scored.reason}")
    return [np.asarray(row, float) for row in scored.rows]


def _wider(interval: Estimate, test: TTest) -> Estimate:
    """Returns the smallest interval that contains both, because few seeds make the bootstrap's too narrow.

    For a single score per seed, such as a correlation, there is no bootstrap interval, and the test's is returned.
    """
    low = test.difference.low
    high = test.difference.high
    if interval.low is None or interval.high is None or low is None or high is None:
        return test.difference
    return Estimate(interval.value, min(interval.low, low), max(interval.high, high))
