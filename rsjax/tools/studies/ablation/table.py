"""Reads the results of a grid's cells and makes their table: a row per combination, mean ± deviation over the seeds."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from rsjax.evaluation.registry import ABSENT, Footnotes, Metric, metrics
from rsjax.files import FileError, holder, is_held, read_json
from rsjax.models.base import create_model
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.ablation.grid import Value, values_of
from rsjax.training.log import read_log

ERROR = "error.json"  # in the directory of a cell that failed
FINAL_SHARE = 0.1  # share of the logged steps, at the end, over which a loss term is averaged
LEGEND = (
    "Mean ± sample standard deviation over the finished seeds (of all). **Bold**: the best mean of its column, "
    "which may be chance. L: training loss terms, mean over the last tenth of the logged steps."
)
State = Literal["finished", "running", "failed", "interrupted", "missing"]


@dataclass(frozen=True)
class Result:
    """A cell's state, and its metrics once it is finished.

    Attributes:
        reason: one line that says why there are no metrics.
        metrics: the numbers of ``metrics.json``, and the loss terms (``loss_rgb``, …) at the end of training.
        reasons: why a registered metric has no number, by name.
    """

    run: Run
    state: State
    reason: str
    metrics: Mapping[str, float]
    reasons: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The cell's name."""
        return self.run.directory.name


class Spread(NamedTuple):
    """Mean and sample standard deviation (n - 1; None for one value) of n values."""

    mean: float
    std: float | None
    n: int


@dataclass(frozen=True)
class Row:
    """The cells that differ only in their seed.

    Attributes:
        values: the value of every field that varies.
        results: one per seed.
        spreads: those of the finished results, for every metric that any of them has.
    """

    values: dict[str, Value]
    results: tuple[Result, ...]
    spreads: Mapping[str, Spread]

    @property
    def label(self) -> str:
        """The row's values, such as ``model.use_depth True, model.loss.use_keypoints False``."""
        return ", ".join(f"{name} {value}".strip() for name, value in self.values.items()) or "as configured"

    @property
    def reasons(self) -> dict[str, str]:
        """Why a result of the row has no number for a metric, by name."""
        return {name: reason for result in self.results for name, reason in result.reasons.items()}


def read_result(run: Run) -> Result:
    """Reads a cell's state and metrics; damaged files count as unfinished, and nothing is changed."""
    if (metrics := read_metrics(run)) is not None:  # even while another command evaluates it again
        return Result(run, "finished", "", metrics, read_reasons(run))
    if is_held(run.lock_file):
        return Result(run, "running", f"in {holder(run.lock_file)}", {})
    with suppress(FileError):
        return Result(run, "failed", str(read_json(run.directory / ERROR).get("error")), {})
    if (run.directory / "config.json").exists():
        done = sum(run.finished(stage) for stage in run.stages)
        return Result(run, "interrupted", f"{done} of {len(run.stages)} stages are finished", {})
    return Result(run, "missing", "not started", {})


def read_metrics(run: Run) -> dict[str, float] | None:
    """Returns a run's metrics and final loss terms; None if the run is not finished or a file is damaged."""
    if not run.finished("report"):
        return None
    try:
        saved = read_json(run.directory / "metrics.json")
        log = read_log(run.directory / "world_model")
    except FileError:
        return None
    numbers = {name: float(value) for name, value in saved.items() if isinstance(value, int | float)}
    terms = tuple(create_model(run.config).loss_weights)
    return numbers | final_terms(log, terms)


def read_reasons(run: Run) -> dict[str, str]:
    """Returns why a run's ``metrics.json`` has no number for a metric, by name; empty if the file gives no reasons."""
    with suppress(FileError):
        reasons = read_json(run.directory / "metrics.json").get("reasons")
        return {name: str(reason) for name, reason in reasons.items()} if isinstance(reasons, dict) else {}
    return {}


def final_terms(log: Sequence[Mapping[str, Any]], terms: Sequence[str]) -> dict[str, float]:
    """Returns ``loss_<term>``: each term's mean over the last tenth of the logged steps (at least one)."""
    steps = [row for row in log if any(term in row for term in terms)]  # validation metrics are in separate rows
    last = steps[-max(1, round(FINAL_SHARE * len(steps))) :]
    values = {term: [row[term] for row in last if term in row] for term in terms}
    return {f"loss_{term}": float(np.mean(numbers)) for term, numbers in values.items() if numbers}


def tabulate(results: Iterable[Result], fields: Sequence[str]) -> list[Row]:
    """Groups results by the values of the fields that vary, in the order of their first cells."""
    groups: dict[tuple[Value, ...], list[Result]] = {}
    for result in results:
        groups.setdefault(tuple(values_of(result.run.config, fields).values()), []).append(result)
    rows = []
    for values, group in groups.items():
        names = dict.fromkeys(name for result in group for name in result.metrics)
        spreads = {name: spread([r.metrics[name] for r in group if name in r.metrics]) for name in names}
        rows.append(Row(dict(zip(fields, values, strict=True)), tuple(group), spreads))
    return rows


def spread(values: Sequence[float]) -> Spread:
    """Returns mean, sample standard deviation and count of one or more values."""
    std = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Spread(float(np.mean(values)), std, len(values))


def best(rows: Sequence[Row], column: Metric) -> set[int]:
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
    columns, fields, notes = shown_columns(rows, with_reasons=True), list(rows[0].values), Footnotes()
    texts = [[*fields, "seeds", *(column.heading for column in columns)]]
    for row in rows:
        finished = sum(result.state == "finished" for result in row.results)
        values = [str(value).replace("|", r"\|") for value in row.values.values()]
        texts.append([*values, f"{finished}/{len(row.results)}", *(_number(row, column, notes) for column in columns)])
    for x, column in enumerate(columns, start=len(fields) + 1):
        for y in best(rows, column):
            texts[y + 1][x] = f"**{texts[y + 1][x]}**"
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    texts.insert(1, ["-" * width for width in widths])
    lines = [" | ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)) for line in texts]
    parts = ["\n".join(f"| {line} |" for line in lines), LEGEND, *notes.texts]
    absent = [result for row in rows for result in row.results if result.state != "finished"]
    if absent:
        parts.append("Not in the table:\n\n" + "\n".join(f"- {r.name}: {r.state} ({r.reason})" for r in absent))
    return "\n\n".join(parts) + "\n"


def _number(row: Row, column: Metric, notes: Footnotes) -> str:
    if column.name not in row.spreads:
        return ABSENT + notes.mark(row.reasons.get(column.name))
    return " ± ".join(f"{x:.{column.decimals}f}" for x in row.spreads[column.name][:2] if x is not None)


def as_csv(rows: Sequence[Row]) -> str:
    """Returns one line per row: its values, then mean, deviation and n of every metric; absent numbers are empty."""
    names = dict.fromkeys(name for row in rows for name in row.spreads)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*rows[0].values, *(f"{name}_{part}" for name in names for part in Spread._fields)])
    for row in rows:
        numbers = [number for name in names for number in row.spreads.get(name, (None, None, 0))]
        writer.writerow([*row.values.values(), *numbers])
    return text.getvalue()


def as_json(rows: Sequence[Row]) -> dict[str, Any]:
    """Returns the rows with all their metrics, the best rows of each column, and every cell with its state."""
    return {
        "rows": [{"values": row.values} | {k: s._asdict() for k, s in row.spreads.items()} for row in rows],
        "best": {column.name: sorted(best(rows, column)) for column in shown_columns(rows)},
        "cells": [_cell_json(result) for row in rows for result in row.results],
    }


def _cell_json(result: Result) -> dict[str, Any]:
    return {
        "name": result.name,
        "seed": result.run.config.train.seed,
        "state": result.state,
        "reason": result.reason,
        "metrics": dict(result.metrics),
        "reasons": dict(result.reasons),
    }
