"""Computes a comparison and writes it as Markdown, CSV and JSON."""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rsjax.config import require
from rsjax.errors import did_you_mean
from rsjax.evaluation.registry import ABSENT, Footnotes, Metric
from rsjax.evaluation.statistics import Estimate
from rsjax.tools.studies.compare.groups import Group, noted
from rsjax.tools.studies.compare.published import SOURCE, published, published_name, score_of
from rsjax.tools.studies.compare.scores import Cell, Difference, Entry, cell, columns, difference, entries_of


@dataclass(frozen=True)
class Comparison:
    """All numbers of a comparison.

    Attributes:
        entries: groups, then baselines.
        reference: the entry that the others are compared with.
        cells: by metric, one for each entry.
        differences: from the reference, by metric, one for each entry; None for the reference itself and where a score
            is missing.
        papers: published row → its scores by metric.
        notes: differences between the results that do not forbid a comparison.
    """

    groups: Sequence[Group]
    entries: Sequence[Entry]
    metrics: Sequence[Metric]
    reference: Entry
    cells: dict[str, list[Cell]]
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
    entries, chosen = entries_of(groups), columns(groups, only)
    reference = entries[names.index(against) if against else 0]
    protocol = groups[0].results[0].protocol["name"]
    rows = dict.fromkeys(published_name(result.model) for group in groups for result in group.results)
    papers = {name: scores for name in rows if name and (scores := published(name, protocol))}
    return Comparison(
        groups,
        entries,
        chosen,
        reference,
        {each.name: [cell(entry, each) for entry in entries] for each in chosen},
        {
            each.name: [None if entry is reference else difference(entry, reference, each) for entry in entries]
            for each in chosen
        },
        papers,
        noted(groups),
    )


def published_score(comparison: Comparison, metric: Metric, name: str) -> float | None:
    """Returns the score in the published row ``name`` to show next to one of our metrics."""
    protocol = comparison.protocol
    plain = protocol["depth_alignment"] == "none"
    suffix = "" if plain else f"_{protocol['depth_alignment']}_{protocol['depth_source']}"
    return score_of(comparison.papers[name], metric.name, suffix)


def header(comparison: Comparison) -> list[str]:
    """Returns the headings of the table of scores."""
    own = [f"{entry.name} (n = {len(entry.group.results)})" for entry in comparison.entries if not entry.suffix]
    baselines = [entry.name for entry in comparison.entries if entry.suffix]
    return ["metric", *own, *baselines, *(f"published: {name}" for name in comparison.papers)]


def score_rows(comparison: Comparison, notes: Footnotes) -> list[list[str]]:
    """Returns a row for each metric: each entry's mean ± deviation over seeds and interval, then published numbers."""
    rows = []
    for metric in comparison.metrics:
        cells = [_cell_text(each, metric, notes) for each in comparison.cells[metric.name]]
        papers = [published_score(comparison, metric, name) for name in comparison.papers]
        rows.append([metric.heading, *cells, *(ABSENT if value is None else f"{value:g}" for value in papers)])
    return rows


def _cell_text(each: Cell, metric: Metric, notes: Footnotes) -> str:
    if each.spread is None:
        return ABSENT + notes.mark(each.reason)
    numbers = " ± ".join(f"{x:.{metric.decimals}f}" for x in each.spread[:2] if x is not None)
    return f"{numbers} {_interval(each.interval, metric.decimals)}".rstrip()


def _interval(interval: Estimate | None, decimals: int) -> str:
    if interval is None or interval.low is None or interval.high is None:
        return ""
    return f"[{interval.low:.{decimals}f}, {interval.high:.{decimals}f}]"


def difference_rows(comparison: Comparison) -> list[list[str]]:
    """Returns a row for each metric and entry other than the reference."""
    rows = []
    for metric in comparison.metrics:
        digits = metric.decimals + 1
        for entry, found in zip(comparison.entries, comparison.differences[metric.name], strict=True):
            if found is None:
                continue
            estimate = found.interval or (found.welch.difference if found.welch else None)
            value = f"{estimate.value:+.{digits}f}" if estimate else ABSENT
            test = f"t = {found.welch.t:.2f}, p = {found.welch.p:.3g}" if found.welch else ABSENT
            interval = _interval(found.interval, digits) or ABSENT
            rows.append([metric.heading, entry.name, value, interval, test, found.finding])
    return rows


DIFFERENCES = ("metric", "entry", "difference", "95 % interval over seeds and clips", "Welch over seeds", "finding")


def legend(comparison: Comparison) -> list[str]:
    """Returns the paragraphs below the tables."""
    name, counts = comparison.reference.name, {len(group.results) for group in comparison.groups}
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
        lines.append(f"Published: {SOURCE}. Its LPIPS network and depth alignment are not stated.")
    return lines + comparison.notes


def as_markdown(comparison: Comparison) -> str:
    """Returns the tables of scores and of differences, with their legend and the reasons for absent numbers."""
    notes = Footnotes()
    scores = _markdown(header(comparison), score_rows(comparison, notes))
    differences = _markdown(DIFFERENCES, difference_rows(comparison))
    paragraphs = [comparison.title, scores, differences, *legend(comparison), *notes.texts]
    return "\n\n".join(paragraphs) + "\n"


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    texts = [[cell.replace("|", r"\|") for cell in row] for row in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    texts.insert(1, ["-" * width for width in widths])
    lines = [" | ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)) for line in texts]
    return "\n".join(f"| {line} |" for line in lines)


def as_csv(comparison: Comparison) -> str:
    """Returns a line for each metric and entry: score, interval, and the difference from the reference."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_FIELDS)
    for row in _records(comparison):
        writer.writerow([row.get(name) for name in _FIELDS])
    return text.getvalue()


_FIELDS = (
    *("metric", "entry", "kind", "mean", "std", "n", "low", "high"),
    *("difference", "difference_low", "difference_high", "t", "df", "p", "finding", "reason"),
)


def _records(comparison: Comparison) -> list[dict[str, Any]]:
    """Returns a record for each metric and entry, and for each published number; its keys are the CSV's columns."""
    out = []
    for metric in comparison.metrics:
        found = zip(comparison.entries, comparison.cells[metric.name], comparison.differences[metric.name], strict=True)
        for entry, each, change in found:
            row: dict[str, Any] = {"metric": metric.name, "entry": entry.name, "reason": each.reason or None}
            row |= {"kind": "baseline" if entry.suffix else "group"}
            row |= each.spread._asdict() if each.spread else {}
            row |= {"low": each.interval.low, "high": each.interval.high} if each.interval else {}
            out.append(row | (_change(change) if change else {}))
        for name in comparison.papers:
            if (value := published_score(comparison, metric, name)) is not None:
                out.append({"metric": metric.name, "entry": name, "kind": "published", "mean": value})
    return out


def _change(change: Difference) -> dict[str, Any]:
    row: dict[str, Any] = {"finding": change.finding}
    if change.interval:
        named = {"difference": change.interval.value, "difference_low": change.interval.low}
        row |= named | {"difference_high": change.interval.high}
    if change.welch is None:
        return row
    t = change.welch.t if math.isfinite(change.welch.t) else None  # infinite if no seed varies; JSON has no infinity
    return row | {"t": t, "df": change.welch.df, "p": change.welch.p}


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
        "published": SOURCE,
        "legend": legend(comparison),
    }
