"""The one table of a grid: every combination of values, with the mean and standard deviation over its seeds."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rsjax.ablation.fields import Value
from rsjax.ablation.results import Result

ABSENT = "–"


@dataclass(frozen=True)
class Metric:
    """A column: its key in a cell's metrics, its heading, the digits shown, and whether more is better."""

    key: str
    heading: str
    digits: int
    more: bool


METRICS = (
    Metric("psnr", "PSNR, dB ↑", 2, True),
    Metric("ssim", "SSIM ↑", 4, True),
    Metric("depth_absrel", "depth AbsRel ↓", 4, False),
    Metric("depth_delta1", "depth δ₁ ↑", 4, True),
    Metric("delta_psnr", "ΔPSNR, dB ↑", 2, True),
    Metric("loss_rgb", "L_RGB ↓", 3, False),
)


@dataclass(frozen=True)
class Spread:
    """Mean and sample standard deviation (n - 1; None for one value) of n values."""

    mean: float
    std: float | None
    n: int

    @classmethod
    def over(cls, values: Iterable[float]) -> "Spread | None":
        """Of these values; None where there are none."""
        array = np.array(list(values), np.float64)
        if not len(array):
            return None
        return cls(float(array.mean()), float(array.std(ddof=1)) if len(array) > 1 else None, len(array))


@dataclass(frozen=True)
class Row:
    """The cells that differ in their seed alone.

    Attributes:
        values: of the fields that vary.
        results: one per seed.
        spreads: over the finished ones, by metric; every metric that any of them has.
    """

    values: Mapping[str, Value]
    results: tuple[Result, ...]
    spreads: Mapping[str, Spread]

    @property
    def label(self) -> str:
        """``model.depth True, loss.keypoints False``."""
        return ", ".join(f"{name} {value}" for name, value in self.values.items()) or "as configured"

    @property
    def finished(self) -> list[Result]:
        return [result for result in self.results if result.state == "finished"]


def tabulate(results: Sequence[Result]) -> list[Row]:
    """Rows in the order of their first cells."""
    groups: dict[tuple[Value, ...], list[Result]] = {}
    for result in results:
        groups.setdefault(tuple(result.cell.values.values()), []).append(result)
    return [_row(group) for group in groups.values()]


def _row(group: list[Result]) -> Row:
    names = dict.fromkeys(name for result in group for name in result.metrics)
    spreads = {name: Spread.over(r.metrics[name] for r in group if name in r.metrics) for name in names}
    return Row(group[0].cell.values, tuple(group), {name: s for name, s in spreads.items() if s is not None})


def best(rows: Sequence[Row], metric: Metric) -> set[int]:
    """The rows with the best mean as shown, to its digits; none where fewer than two rows have one to compare."""
    spreads = {i: row.spreads[metric.key] for i, row in enumerate(rows) if metric.key in row.spreads}
    means = {i: round(spread.mean, metric.digits) for i, spread in spreads.items()}
    means = {i: mean for i, mean in means.items() if not math.isnan(mean)}
    if len(means) < 2:
        return set()
    top = (max if metric.more else min)(means.values())
    return {i for i, mean in means.items() if mean == top}


def present(rows: Sequence[Row]) -> tuple[Metric, ...]:
    """The columns that any row has a number for."""
    return tuple(metric for metric in METRICS if any(metric.key in row.spreads for row in rows))


def markdown(rows: Sequence[Row]) -> str:
    """The table, what its marks mean, and every cell that is not in it with the reason."""
    fields, metrics = list(rows[0].values), present(rows)
    lines = [[*fields, "seeds", *(metric.heading for metric in metrics)]]
    top = {metric.key: best(rows, metric) for metric in metrics}
    for i, row in enumerate(rows):
        numbers = [_cell(row.spreads.get(m.key), m, bold=i in top[m.key]) for m in metrics]
        seeds = f"{len(row.finished)}/{len(row.results)}"
        values = [str(row.values[field]).replace("|", r"\|") for field in fields]
        lines.append([*values, seeds, *numbers])
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    rule = ["-" * width for width in widths]
    padded = [
        [text.ljust(width) for text, width in zip(line, widths, strict=True)] for line in (lines[0], rule, *lines[1:])
    ]
    table = "\n".join(f"| {' | '.join(line)} |" for line in padded)
    legend = (
        "Mean ± sample standard deviation over the finished seeds (of all). **Bold**: the best mean of its column, "
        "which need not be more than chance. L_RGB: training loss, mean over the last tenth of the logged steps."
    )
    return "\n\n".join([table, legend, *_absent(rows)]) + "\n"


def _cell(spread: Spread | None, metric: Metric, bold: bool) -> str:
    if spread is None:
        return ABSENT
    text = f"{spread.mean:.{metric.digits}f}" + ("" if spread.std is None else f" ± {spread.std:.{metric.digits}f}")
    return f"**{text}**" if bold else text


def _absent(rows: Sequence[Row]) -> list[str]:
    left = [result for row in rows for result in row.results if result.state != "finished"]
    if not left:
        return []
    return ["Not in the table:\n\n" + "\n".join(f"- {r.cell.name}: {r.state} ({r.reason})" for r in left)]


def as_csv(rows: Sequence[Row]) -> str:
    """One line per row: the values, then mean, standard deviation and n of every metric; empty where there is none."""
    names = list(dict.fromkeys(name for row in rows for name in row.spreads))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*rows[0].values, *(f"{name}_{part}" for name in names for part in ("mean", "std", "n"))])
    for row in rows:
        spreads = [row.spreads.get(name) for name in names]
        parts = [part for s in spreads for part in ((s.mean, s.std, s.n) if s else (None, None, 0))]
        writer.writerow([*row.values.values(), *parts])
    return text.getvalue()


def as_json(rows: Sequence[Row]) -> dict[str, Any]:
    """Everything: rows with all their metrics, which row is best in each column, and every cell with its state."""
    return {
        "rows": [{"values": dict(row.values)} | {name: vars(s) for name, s in row.spreads.items()} for row in rows],
        "best": {metric.key: sorted(best(rows, metric)) for metric in present(rows)},
        "cells": [
            {"name": r.cell.name, "seed": r.cell.seed, "state": r.state, "reason": r.reason, "metrics": dict(r.metrics)}
            for row in rows
            for r in row.results
        ],
    }
