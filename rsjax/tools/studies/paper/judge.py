"""Judges claims by the per-clip scores of their cells."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from rsjax.evaluation.registry import Metric, Unavailable, metrics
from rsjax.evaluation.statistics import (
    Estimate,
    Verdict,
    Welch,
    can_lose,
    paired_bootstrap,
    share_difference,
    verdict,
    welch,
)
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.paper.claim import Claim, Comparison
from rsjax.tools.studies.paper.measurements import read_scores
from rsjax.tools.studies.paper.plan import Cell, Plan
from rsjax.tools.studies.results import RunResult, Spread, read_run, spread

CEILING = "psnr_tokenizer"  # PSNR of the reconstruction by each family's own autoencoder, a limit on the prediction's
SUCCESS = "success"  # the name of scores that are 1 or 0 for each trial; all trials may end alike


@dataclass(frozen=True)
class Judged:
    """A comparison with its measurements and verdict.

    Attributes:
        comparison: what was claimed.
        metric: the metric of the comparison.
        seeds: the numbers of finished seeds of both arms.
        published: the paper's difference, if it has one.
        sides: both scores, means over seeds.
        difference: the arm claimed to be better minus the other, with an interval over seeds and clips.
        test: Welch's t-test over the seeds; None with fewer than two seeds.
        clips: the number of clips that have a score in all seeds of both arms.
        verdict: by the interval that contains both the difference's and the test's.
        reason: why there is no difference, or why its interval gives no verdict.
    """

    comparison: Comparison
    metric: Metric
    seeds: tuple[int, int]
    published: float | None = None
    sides: tuple[float, float] | None = None
    difference: Estimate | None = None
    test: Welch | None = None
    clips: int = 0
    verdict: Verdict = "cannot tell"
    reason: str = ""


@dataclass(frozen=True)
class Trained:
    """An arm's cells and their results.

    Attributes:
        name: the arm's name.
        cells: one for each seed, including those that the budget leaves out.
        results: the results of the same cells.
        absent: why the arm cannot be trained; empty if it can.
        spreads: mean and deviation over finished seeds of the claim's scores, by metric or name in ``Claim.beside``.
    """

    name: str
    cells: tuple[Cell, ...]
    results: tuple[RunResult, ...]
    absent: str
    spreads: Mapping[str, Spread]

    @property
    def finished(self) -> tuple[RunResult, ...]:
        """The results of finished seeds."""
        return tuple(result for result in self.results if result.state == "finished")


@dataclass(frozen=True)
class Outcome:
    """A claim with all that was measured for it."""

    claim: Claim
    arms: tuple[Trained, ...]
    judged: tuple[Judged, ...]

    @property
    def counts(self) -> dict[Verdict, int]:
        """The number of comparisons with each verdict, among those that could be made."""
        counts: dict[Verdict, int] = {"holds": 0, "does not hold": 0, "cannot tell": 0}
        for each in self.judged:
            if each.difference is not None:
                counts[each.verdict] += 1
        return counts

    @property
    def verdict(self) -> Verdict:
        """The verdict on the whole claim, from the comparisons that could be made.

        "holds" if all of them hold, "does not hold" if any does not hold; otherwise "cannot tell".
        """
        counts = self.counts
        if counts["does not hold"]:
            return "does not hold"
        return "holds" if counts["holds"] and not counts["cannot tell"] else "cannot tell"


def judge_all(plan: Plan, runs: Mapping[str, Run]) -> list[Outcome]:
    """Judges all claims of a plan by the cells that have finished so far.

    Args:
        runs: the run of each cell of the plan, by name.
    """
    results = {name: read_run(runs[name]) for name in plan.cells}
    read: dict[tuple[str, str], tuple[Mapping[str, Sequence[float]], str]] = {}
    sources = {"", *(name for claim in plan.claims for arm in claim.arms for name in claim.measurements(arm.name))}
    for name, result in results.items():
        for source in sources:
            if result.state == "finished":
                read[name, source] = read_scores(runs[name], source)
    return [_judge_claim(claim, plan, results, read) for claim in plan.claims]


def _judge_claim(claim: Claim, plan: Plan, results: Mapping[str, RunResult], read: Mapping[Any, Any]) -> Outcome:
    arms = {}
    for arm in claim.arms:
        cells = plan.of(claim.name, arm.name)
        found = tuple(results[cell.name] for cell in cells)
        finished = [result.metrics for result in found if result.state == "finished"]
        names = dict.fromkeys([*(each.metric for each in claim.comparisons), CEILING])
        values = {name: [scores[name] for scores in finished if name in scores] for name in names}
        for name, source in claim.beside.items():
            measured = [read[result.name, source][0] for result in found if result.state == "finished"]
            values[name] = [float(np.mean(scores[name])) for scores in measured if name in scores]
        spreads = {name: spread(numbers) for name, numbers in values.items() if numbers}
        arms[arm.name] = Trained(arm.name, cells, found, plan.absent.get((claim.name, arm.name), ""), spreads)
    judged = tuple(_judge(claim, each, arms, read) for each in claim.comparisons)
    return Outcome(claim, tuple(arms.values()), judged)


def _judge(claim: Claim, comparison: Comparison, arms: Mapping[str, Trained], read: Mapping[Any, Any]) -> Judged:
    metric = metrics().get(comparison.metric) or Metric(comparison.metric, comparison.metric, "", "higher", 3)
    better = arms[comparison.better]
    than = arms[comparison.than]
    judged = Judged(comparison, metric, (len(better.finished), len(than.finished)), _published(claim, comparison))
    try:
        a, b = _paired(better, than, comparison, read)
    except Unavailable as reason:
        return replace(judged, reason=str(reason))
    summarise = np.mean if metric.statistic == "mean" else np.median
    one, other = (summarise(scores, axis=1) for scores in (a, b))
    success = comparison.metric == SUCCESS
    difference = share_difference(a, b) if success else paired_bootstrap(a, b, statistic=metric.statistic)
    judged = replace(judged, sides=(one.mean(), other.mean()), difference=difference, clips=a.shape[1])
    test = welch(one, other)
    if test is None:
        return replace(judged, reason="one seed says nothing about others")
    judged = replace(judged, test=test)
    if success and not can_lose(b, -comparison.margin):
        return replace(judged, reason="the other side succeeds too seldom for a loss of the margin to show")
    return replace(judged, verdict=verdict(_wider(difference, test), metric.better, comparison.margin))


def _paired(
    better: Trained, than: Trained, comparison: Comparison, read: Mapping[Any, Any]
) -> tuple[Float[np.ndarray, "S B"], Float[np.ndarray, "Z B"]]:
    """Returns both arms' scores by seed, for the clips that have a finite score in all seeds of both.

    Raises:
        Unavailable: there is nothing to compare.
    """
    a = _scores(better, comparison.score or comparison.metric, comparison, read)
    b = _scores(than, comparison.than_score or comparison.metric, comparison, read)
    if better is not than and better.cells == than.cells:
        raise Unavailable("both arms are the same configuration in this preset")
    if a.shape[1] != b.shape[1]:
        raise Unavailable(f"scores of {a.shape[1]} and {b.shape[1]} clips cannot be paired")
    kept = np.isfinite(a).all(0) & np.isfinite(b).all(0)
    if not kept.any():
        raise Unavailable("no clip has a score in all seeds of both")
    return a[:, kept], b[:, kept]


def _scores(arm: Trained, score: str, comparison: Comparison, read: Mapping[Any, Any]) -> Float[np.ndarray, "S B"]:
    """Returns an arm's scores by seed.

    Raises:
        Unavailable: no seed has finished, a finished seed lacks this score, or seeds have different numbers of clips.
    """
    if arm.absent or not arm.finished:
        raise Unavailable(f"{arm.name}: {arm.absent or 'no seed has finished'}")
    rows = []
    for cell, result in zip(arm.cells, arm.results, strict=True):
        if result.state == "finished":
            scores, reason = read[cell.name, comparison.measurement]
            if score not in scores:
                reason = reason or result.reasons.get(comparison.metric) or f"no score named {score}"
                raise Unavailable(f"{arm.name}: {reason}")
            rows.append(np.asarray(scores[score], float))
    if len({len(row) for row in rows}) > 1:
        raise Unavailable(f"{arm.name}: its seeds were scored on different numbers of clips")
    return np.stack(rows)


def _published(claim: Claim, comparison: Comparison) -> float | None:
    better, than = (claim.arm(name).published for name in (comparison.better, comparison.than))
    score = comparison.score or comparison.metric
    other = comparison.than_score or comparison.metric
    return better[score] - than[other] if score in better and other in than else None


def _wider(interval: Estimate, test: Welch) -> Estimate:
    """Returns the smallest interval that contains both, because few seeds make the bootstrap's too narrow.

    For a single score per seed, such as a correlation, there is no bootstrap interval, and Welch's is returned.
    """
    low = test.difference.low
    high = test.difference.high
    if interval.low is None or interval.high is None or low is None or high is None:
        return test.difference
    return Estimate(interval.value, min(interval.low, low), max(interval.high, high))
