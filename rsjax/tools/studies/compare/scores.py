"""Computes the numbers of a comparison: means over seeds, intervals over seeds and clips, differences and findings.

Axes: S seeds, B clips.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from rsjax.config import require
from rsjax.errors import did_you_mean
from rsjax.evaluation.registry import Metric, metrics
from rsjax.evaluation.statistics import Estimate, TTest, Verdict, paired_bootstrap, verdict, welch
from rsjax.tools.studies.compare.groups import Group
from rsjax.tools.studies.results import Spread, spread

BASELINES = {"_repeat_first": "first frame repeated", "_tokenizer": "tokenizer's reconstruction"}
BEST = "_incl_ctx"  # the names of scores of the best of several samples end with this
Finding = Literal["better", "worse", "cannot tell", "same"]


@dataclass(frozen=True)
class Entry:
    """A column of the comparison: a group's prediction, or a baseline of one.

    Attributes:
        suffix: the suffix of its scores' names: "" for the prediction, otherwise one of :data:`BASELINES`.
    """

    name: str
    group: Group
    suffix: str = ""

    def score(self, metric: Metric) -> str:
        """Returns the name of the entry's score in a result, such as ``psnr_tokenizer_second_half``."""
        base = base_of(metric.name)
        return f"{base}{self.suffix}{metric.name.removeprefix(base)}"

    def seeds(self, metric: Metric) -> list[float]:
        """Returns each seed's score over all clips; an empty list if any result has no score."""
        values = [result.metrics.get(self.score(metric)) for result in self.group.results]
        known = [float(value) for value in values if value is not None and math.isfinite(value)]
        if len(known) < len(values):
            return []
        return known

    def per_clip(self, metric: Metric) -> Float[np.ndarray, "S B"] | None:
        """Returns the clips' scores; None if a result has none, or the results' numbers of scores differ."""
        rows = [result.per_clip.get(self.score(metric), []) for result in self.group.results]
        if not rows[0] or len({len(row) for row in rows}) > 1:
            return None
        return np.array(rows)

    def reason(self, metric: Metric) -> str:
        """Returns why there is no score; "" if that is not recorded."""
        base = base_of(metric.name)
        return next((each.reasons[base] for each in self.group.results if base in each.reasons), "")


@dataclass(frozen=True)
class EntryScore:
    """An entry's score of a metric.

    Attributes:
        spread: mean and standard deviation over seeds; None without a score.
        interval: the interval of this mean over seeds and clips; None for a score of the whole set.
        reason: why there is no score.
    """

    spread: Spread | None
    interval: Estimate | None
    reason: str


@dataclass(frozen=True)
class Difference:
    """An entry's score minus the reference's.

    Attributes:
        interval: over seeds and clips, paired; None if single clips have no scores.
        welch: over seeds; None for baselines and with fewer than two seeds each.
        finding: "better" or "worse" only if all existing intervals say so; "same" if they are all exactly 0.
    """

    interval: Estimate | None
    welch: TTest | None
    finding: Finding


def entries_of(groups: Sequence[Group]) -> list[Entry]:
    """Returns the groups' predictions and both baselines; a baseline appears once if it scores alike in all groups."""
    entries = [Entry(group.name, group) for group in groups]
    psnr = metrics()["psnr"]
    for suffix, name in BASELINES.items():
        own_entries: list[Entry] = []
        for group in groups:
            entry = Entry(name, group, suffix)
            if entry.seeds(psnr) and not any(set(entry.seeds(psnr)) == set(other.seeds(psnr)) for other in own_entries):
                own_entries.append(entry)
        if len(own_entries) > 1:
            own_entries = [replace(each, name=f"{name}, {each.group.name}") for each in own_entries]
        entries += own_entries
    return entries


def columns(groups: Sequence[Group], only: Sequence[str] = ()) -> list[Metric]:
    """Returns the metrics to compare: those of tables with the protocol's depth scores, or those that match patterns.

    Raises:
        ConfigError: a pattern matches no metric of the results.
    """
    results = [result for group in groups for result in group.results]
    names = dict.fromkeys(name for result in results for name in result.metrics)
    suffix = depth_suffix(groups[0].results[0].protocol)
    depth = {f"depth_{each}{suffix}" for each in ("absrel", "delta1", "delta2")}
    scored = [
        replace(each, column=each.column or each.name in depth) for each in metrics().values() if each.name in names
    ]
    # Parts of metrics, such as ``delta_psnr_t4``; only those of the best of samples are table columns.
    for name in names:
        base = base_of(name)
        part = name.removeprefix(base)
        whole = name.rpartition("_")[0]
        bound = part.endswith(("_low", "_high")) and whole in names
        if base and part and not bound and not part.startswith(tuple(BASELINES)):
            best = part.endswith(BEST)
            words = part[1:].replace("_", " ")
            if best:
                words = f"best of {part.removeprefix('_best').removesuffix(BEST)}, prompt included"
            metric = metrics()[base]
            scored.append(replace(metric, name=name, title=f"{metric.title}, {words}", column=best))
    if not only:
        other_depth = {each.name for each in scored if each.name.startswith("depth_")} - depth
        return [each for each in scored if each.column and each.name not in other_depth]
    known = [each.name for each in scored]
    for pattern in only:
        fits = any(fnmatchcase(name, pattern) for name in known)
        require(
            fits, f"--only {pattern}: no metric of these results{did_you_mean(pattern, known)} ({', '.join(known)})"
        )
    return [each for each in scored if any(fnmatchcase(each.name, pattern) for pattern in only)]


def depth_suffix(protocol: Mapping[str, Any]) -> str:
    """Returns the end of the names of depth scores under a protocol, such as ``_scale_branch``."""
    if protocol["depth_alignment"] == "none":
        return ""
    return f"_{protocol['depth_alignment']}_{protocol['depth_source']}"


def base_of(score: str) -> str:
    """Returns the registered metric that a score belongs to: the longest name that the score's begins with, or ""."""
    return max((name for name in metrics() if f"{score}_".startswith(f"{name}_")), key=len, default="")


def score_of(entry: Entry, metric: Metric) -> EntryScore:
    """Returns an entry's score of a metric."""
    seeds = entry.seeds(metric)
    clips = entry.per_clip(metric)
    if not seeds:
        return EntryScore(None, None, entry.reason(metric))
    interval = None
    if clips is not None:
        interval = paired_bootstrap(clips, 0 * clips[:1], statistic=metric.statistic)
    return EntryScore(spread(seeds), interval, "")


def difference(entry: Entry, reference: Entry, metric: Metric) -> Difference | None:
    """Compares an entry with the reference; None where one of them has no score."""
    seeds = entry.seeds(metric)
    others = reference.seeds(metric)
    if not seeds or not others:
        return None
    clips = entry.per_clip(metric)
    base = reference.per_clip(metric)
    intervals = []
    interval = None
    if clips is not None and base is not None and clips.shape[1] == base.shape[1]:
        interval = paired_bootstrap(clips, base, statistic=metric.statistic)
        intervals.append(interval)
    test = None
    if not entry.suffix and not reference.suffix:
        test = welch(np.array(seeds), np.array(others))
    if test is not None:
        intervals.append(test.difference)
    verdicts = {verdict(each, metric.better) for each in intervals}
    finding: Finding = "cannot tell"
    if intervals and all(each.value == each.low == each.high == 0 for each in intervals):
        finding = "same"
    elif len(verdicts) == 1:
        words: dict[Verdict, Finding] = {"holds": "better", "does not hold": "worse"}
        finding = words.get(verdicts.pop(), "cannot tell")
    return Difference(interval, test, finding)
