"""Computes a comparison and writes it as Markdown, CSV and JSON."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rsjax.config import require
from rsjax.errors import did_you_mean
from rsjax.evaluation.registry import Metric
from rsjax.tools.studies import tables
from rsjax.tools.studies.compare.groups import Group, noted
from rsjax.tools.studies.compare.published import (
    published,
    published_name,
    published_score_of,
    published_text,
    source_of,
)
from rsjax.tools.studies.compare.scores import (
    Difference,
    Entry,
    EntryScore,
    columns,
    depth_suffix,
    difference,
    entries_of,
    score_of,
)
from rsjax.tools.studies.tables import ABSENT, CellText, Footnotes, Marked, Table, interval_text, mean_text


@dataclass(frozen=True)
class Comparison:
    """All numbers of a comparison.

    Attributes:
        entries: groups, then baselines.
        reference: the entry that the others are compared with.
        scores: by metric, one for each entry.
        differences: from the reference, by metric, one for each entry; None for the reference itself and where a score
            is missing.
        papers: published row → its scores by metric.
        notes: differences between the results that do not forbid a comparison.
    """

    groups: Sequence[Group]
    entries: Sequence[Entry]
    metrics: Sequence[Metric]
    reference: Entry
    scores: dict[str, list[EntryScore]]
    differences: dict[str, list[Difference | None]]
    papers: dict[str, dict[str, float]]
    notes: list[str]

    @property
    def protocol(self) -> dict[str, Any]:
        """The protocol of all results."""
        return self.groups[0].results[0].protocol

    @property
    def title(self) -> str:
        """The protocol, the scored clips and their size, in words."""
        result = self.groups[0].results[0]
        data = result.data
        return (
            f"protocol {result.label}: {len(result.clips)} clips of the split {data['split']} of {data['key']}, "
            f"{data['frames']} frames ({self.protocol['prompt_frames']} given) at {data['image_size']} pixels"
        )


def compare(groups: Sequence[Group], only: Sequence[str] = (), against: str = "") -> Comparison:
    """Computes all numbers of a comparison.

    Args:
        only: names or patterns of metrics; empty: those of tables.
        against: the group that the others are compared with; empty: the first one.

    Raises:
        ConfigError: there is no such group or metric.
    """
    names = [group.name for group in groups]
    require(not against or against in names, f"--against {against}: no such group{did_you_mean(against, names)}")
    entries = entries_of(groups)
    chosen = columns(groups, only)
    reference = entries[0]
    if against:
        reference = entries[names.index(against)]
    protocol = groups[0].results[0].protocol["name"]
    rows = dict.fromkeys(published_name(result.model) for group in groups for result in group.results)
    papers = {name: scores for name in rows if name and (scores := published(name, protocol))}
    return Comparison(
        groups,
        entries,
        chosen,
        reference,
        {each.name: [score_of(entry, each) for entry in entries] for each in chosen},
        {
            each.name: [None if entry is reference else difference(entry, reference, each) for entry in entries]
            for each in chosen
        },
        papers,
        noted(groups),
    )


def published_score(comparison: Comparison, metric: Metric, name: str) -> float | None:
    """Returns the score in the published row ``name`` to show next to one of our metrics."""
    return published_score_of(comparison.papers[name], metric.name, depth_suffix(comparison.protocol))


def score_table(comparison: Comparison, notes: Footnotes) -> Table:
    """Makes a row for each metric: each entry's mean ± deviation over seeds and interval, then published numbers."""
    head: list[CellText] = ["metric"]
    head += [f"{entry.name} (n = {len(entry.group.results)})" for entry in comparison.entries if not entry.suffix]
    head += [entry.name for entry in comparison.entries if entry.suffix]
    head += [Marked(f"published: {name}", "published") for name in comparison.papers]
    rows = []
    for metric in comparison.metrics:
        row: list[CellText] = [metric.heading]
        for score in comparison.scores[metric.name]:
            if score.spread is None:
                row.append(notes.absent(score.reason))
            else:
                mean = mean_text(score.spread, metric.decimals)
                row.append(f"{mean} {interval_text(score.interval, metric.decimals)}".rstrip())
        for name in comparison.papers:
            value = published_score(comparison, metric, name)
            row.append(Marked(ABSENT if value is None else published_text(metric.name, value), "published"))
        rows.append(row)
    return Table(head, rows)


def difference_table(comparison: Comparison) -> Table:
    """Makes a row for each metric and entry other than the reference."""
    rows = []
    for metric in comparison.metrics:
        digits = metric.decimals + 1
        for entry, outcome in zip(comparison.entries, comparison.differences[metric.name], strict=True):
            if outcome is None:
                continue
            estimate = outcome.interval
            test = ABSENT
            if outcome.welch:
                estimate = estimate or outcome.welch.difference
                test = f"t = {outcome.welch.t:.2f}, p = {outcome.welch.p:.3g}"
            value = f"{estimate.value:+.{digits}f}" if estimate else ABSENT
            interval = interval_text(outcome.interval, digits) or ABSENT
            finding: CellText = outcome.finding
            if outcome.finding == "better":
                finding = Marked("better", "met")
            elif outcome.finding == "worse":
                finding = Marked("worse", "missed")
            rows.append([metric.heading, entry.name, value, interval, test, finding])
    head = ("metric", "entry", "difference", "95 % interval over seeds and clips", "Welch over seeds", "finding")
    return Table(head, rows)


def legend(comparison: Comparison) -> list[str]:
    """Returns the paragraphs below the tables."""
    name = comparison.reference.name
    counts = {len(group.results) for group in comparison.groups}
    lines = [
        "Scores: mean ± sample standard deviation over n seeds, [95 % interval over seeds and clips].",
        f'Differences are from {name}, paired by clip; intervals resample seeds and clips. "better" and "worse" stand '
        f"only where every interval there is, that of Welch's t over seeds too, excludes zero. No correction for many "
        f"comparisons.",
    ]
    if medians := [metric.title for metric in comparison.metrics if metric.statistic == "median"]:
        lines.insert(1, f"Each seed's score is its median over clips, not its mean: {'; '.join(medians)}.")
    if 1 in counts:
        lines.append("A group of one seed is one training: its intervals say nothing about other seeds.")
    if comparison.papers:
        source = source_of(comparison.protocol["name"])
        lines.append(f"Published: {source}. Its LPIPS network and depth alignment are not stated.")
    return lines + comparison.notes


def as_markdown(comparison: Comparison) -> str:
    """Returns the tables of scores and of differences, with their legend and the reasons for absent numbers."""
    notes = Footnotes()
    scores = tables.as_markdown(score_table(comparison, notes))
    differences = tables.as_markdown(difference_table(comparison))
    paragraphs = [comparison.title, scores, differences, *legend(comparison), *notes.texts]
    return "\n\n".join(paragraphs) + "\n"


def as_csv(comparison: Comparison) -> str:
    """Returns a line for each metric and entry: score, interval, and the difference from the reference."""
    return tables.as_csv(_FIELDS, [[row.get(name) for name in _FIELDS] for row in _records(comparison)])


_FIELDS = (
    *("metric", "entry", "kind", "mean", "std", "n", "low", "high"),
    *("difference", "difference_low", "difference_high", "t", "df", "p", "finding", "reason"),
)


def _records(comparison: Comparison) -> list[dict[str, Any]]:
    """Returns a record for each metric and entry, and for each published number; its keys are the CSV's columns."""
    out = []
    for metric in comparison.metrics:
        scores = comparison.scores[metric.name]
        differences = comparison.differences[metric.name]
        for entry, each, change in zip(comparison.entries, scores, differences, strict=True):
            row: dict[str, Any] = {"metric": metric.name, "entry": entry.name, "reason": each.reason or None}
            row |= {"kind": "baseline" if entry.suffix else "group"}
            if each.spread:
                row |= each.spread._asdict()
            if each.interval:
                row |= {"low": each.interval.low, "high": each.interval.high}
            if change:
                row["finding"] = change.finding
            if change and change.interval:
                row |= {
                    "difference": change.interval.value,
                    "difference_low": change.interval.low,
                    "difference_high": change.interval.high,
                }
            if change and change.welch:
                row |= {"t": change.welch.t, "df": change.welch.df, "p": change.welch.p}
                if not math.isfinite(change.welch.t):  # no seed varies; JSON has no infinity
                    row["t"] = None
            out.append(row)
        for name in comparison.papers:
            if (value := published_score(comparison, metric, name)) is not None:
                out.append({"metric": metric.name, "entry": name, "kind": "published", "mean": value})
    return out


def as_json(comparison: Comparison) -> dict[str, Any]:
    """Returns the records of the CSV with protocol, data and the origin of each result."""
    first = comparison.groups[0].results[0]
    made = {
        group.name: [
            {"result": str(folder), "model": result.model, "code": result.code, "made": result.made, "key": result.key}
            for folder, result in zip(group.folders, group.results, strict=True)
        ]
        for group in comparison.groups
    }
    return {
        "protocol": first.protocol,
        "data": first.data,
        "clips": first.clips,
        "reference": comparison.reference.name,
        "groups": made,
        "scores": _records(comparison),
        "published": source_of(first.protocol["name"]),
        "legend": legend(comparison),
    }
