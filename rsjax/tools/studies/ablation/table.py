"""Makes the table of a grid's cells: a row per combination of values, mean ± deviation over the seeds."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from rsjax.evaluation.registry import Metric, metrics
from rsjax.tools.studies import tables
from rsjax.tools.studies.ablation.grid import Value, values_of
from rsjax.tools.studies.results import RunResult, Spread, spread
from rsjax.tools.studies.tables import CellText, Footnotes, Marked, Table, mean_text

LEGEND = (
    "Mean ± sample standard deviation over the finished seeds (of all). **Bold**: the best mean of its column, "
    "which may be chance. L: training loss terms, mean over the last tenth of the logged steps."
)


@dataclass(frozen=True)
class Row:
    """The cells that differ only in their seed.

    Attributes:
        values: the value of every field that varies.
        results: one per seed.
        spreads: those of the finished results, for every metric that any of them has.
    """

    values: dict[str, Value]
    results: tuple[RunResult, ...]
    spreads: Mapping[str, Spread]

    @property
    def label(self) -> str:
        """The row's values, such as ``model.depth head, model.loss.keypoints none``."""
        return ", ".join(f"{name} {value}".strip() for name, value in self.values.items()) or "as configured"

    def by_seed(self, name: str) -> list[float]:
        """Returns the results' scores by a metric, without those of results that lack it."""
        return [result.metrics[name] for result in self.results if name in result.metrics]

    @property
    def reasons(self) -> dict[str, str]:
        """The reasons why results of the row have no number for a metric, by name."""
        return {name: reason for result in self.results for name, reason in result.reasons.items()}


class HasSpreads(Protocol):
    """A row with means over seeds."""

    @property
    def spreads(self) -> Mapping[str, Spread]:
        """Mean and deviation over seeds, by metric."""


def tabulate(results: Iterable[RunResult], fields: Sequence[str]) -> list[Row]:
    """Groups results by the values of the fields that vary, in the order of their first cells."""
    groups: dict[tuple[Value, ...], list[RunResult]] = {}
    for result in results:
        groups.setdefault(tuple(values_of(result.run.config, fields).values()), []).append(result)
    rows = []
    for values, group in groups.items():
        names = dict.fromkeys(name for result in group for name in result.metrics)
        spreads = {name: spread([r.metrics[name] for r in group if name in r.metrics]) for name in names}
        rows.append(Row(dict(zip(fields, values, strict=True)), tuple(group), spreads))
    return rows


def best(rows: Sequence[HasSpreads], column: Metric) -> set[int]:
    """Returns the rows whose mean, rounded as shown, is the best; an empty set if fewer than two rows have a mean."""
    spreads = {i: row.spreads[column.name] for i, row in enumerate(rows) if column.name in row.spreads}
    means = {i: round(s.mean, column.decimals) for i, s in spreads.items() if not math.isnan(s.mean)}
    top = (max if column.better == "higher" else min)(means.values(), default=None)
    return {i for i, mean in means.items() if mean == top} if len(means) > 1 else set()


def shown_columns(rows: Sequence[Row], with_reasons: bool = False) -> tuple[Metric, ...]:
    """Returns the metrics with a column, and the loss terms of the last steps, for which any row has a number.

    Args:
        with_reasons: also return metrics for which a row only has a reason.
    """
    names = dict.fromkeys(name for row in rows for name in row.spreads)
    terms = [name for name in names if name.startswith("loss_")]
    own = [metric for metric in metrics().values() if metric.column]
    columns = [*own, *(Metric(name, f"L_{name[5:]}", "", "lower", 3) for name in terms)]
    known = {*names, *(name for row in rows for name in row.reasons if with_reasons)}
    return tuple(column for column in columns if column.name in known)


def as_markdown(rows: Sequence[Row]) -> str:
    """Returns the table, its legend, reasons for absent metrics, and each cell that is missing, with the reason."""
    columns = shown_columns(rows, with_reasons=True)
    notes = Footnotes()
    tops = {column.name: best(rows, column) for column in columns}
    lines = []
    for number, row in enumerate(rows):
        finished = sum(result.state == "finished" for result in row.results)
        line: list[CellText] = [*map(str, row.values.values()), f"{finished}/{len(row.results)}"]
        for column in columns:
            if column.name not in row.spreads:
                line.append(notes.absent(row.reasons.get(column.name)))
            else:
                text = mean_text(row.spreads[column.name], column.decimals)
                line.append(Marked(text, "best") if number in tops[column.name] else text)
        lines.append(line)
    head = [*rows[0].values, "seeds", *(column.heading for column in columns)]
    parts = [tables.as_markdown(Table(head, lines)), LEGEND, *notes.texts]
    absent = [result for row in rows for result in row.results if result.state != "finished"]
    if absent:
        parts.append("Not in the table:\n\n" + "\n".join(f"- {r.name}: {r.state} ({r.reason})" for r in absent))
    return "\n\n".join(parts) + "\n"


def as_csv(rows: Sequence[Row]) -> str:
    """Returns one line per row: its values, then mean, deviation and n of every metric; absent numbers are empty."""
    names = dict.fromkeys(name for row in rows for name in row.spreads)
    lines = []
    for row in rows:
        numbers = [number for name in names for number in row.spreads.get(name, (None, None, 0))]
        lines.append([*row.values.values(), *numbers])
    return tables.as_csv([*rows[0].values, *(f"{name}_{part}" for name in names for part in Spread._fields)], lines)


def as_json(rows: Sequence[Row]) -> dict[str, Any]:
    """Returns the rows with all their metrics, the best rows of each column, and every cell with its state."""
    cells = [
        {
            "name": result.name,
            "seed": result.run.config.train.seed,
            "state": result.state,
            "reason": result.reason,
            "metrics": dict(result.metrics),
            "reasons": dict(result.reasons),
        }
        for row in rows
        for result in row.results
    ]
    return {
        "rows": [{"values": row.values} | {k: s._asdict() for k, s in row.spreads.items()} for row in rows],
        "best": {column.name: sorted(best(rows, column)) for column in shown_columns(rows)},
        "cells": cells,
    }
