"""Draws a grid's table as a picture: a panel per metric, a line per combination of values."""

import io
import textwrap
from collections.abc import Mapping, Sequence
from typing import Protocol

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rsjax.evaluation.registry import Metric
from rsjax.tools.studies.ablation.table import best
from rsjax.tools.studies.results import Spread
from rsjax.tools.studies.tables import ABSENT

PLAIN = "#3b7dd8"
BEST = "#d9480f"
FAINT = "#868e96"
PANEL = 2.3  # width of a panel in inches
LINE = 0.42  # height of a line in inches
MAX_LINES = 150  # viewers refuse taller pictures
LEGEND = "circles: seeds; bar: mean ± sample standard deviation; orange: best mean, which may be chance"


class Line(Protocol):
    """A line of the picture: a row of a grid, or an arm of a claim."""

    @property
    def label(self) -> str:
        """Its name."""

    @property
    def spreads(self) -> Mapping[str, Spread]:
        """Mean and deviation over seeds, by metric."""

    def by_seed(self, name: str) -> Sequence[float]:
        """Returns the seeds' scores."""


def draw(rows: Sequence[Line], columns: Sequence[Metric], title: str, source: str = "") -> bytes:
    """Returns the picture as PNG: circles are seeds, bars are mean ± sample deviation, and the best mean is orange.

    Args:
        source: what the picture is made of, for its metadata.
    """
    shown = rows[:MAX_LINES]
    left = 0.075 * max(len(row.label) for row in shown)
    size = (left + PANEL * max(1, len(columns)), 1.5 + LINE * len(shown))
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(textwrap.fill(title, int(12 * size[0])), x=0.01, ha="left", fontsize=12)
    figure.supxlabel(LEGEND, fontsize=8, color=FAINT, x=0.01, ha="left")
    if columns:
        panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
        for axes, column in zip(panels, columns, strict=True):
            top = best(rows, column)
            for y, row in enumerate(shown):
                if column.name not in row.spreads:
                    place = axes.get_yaxis_transform()
                    axes.text(0.5, y, ABSENT, transform=place, ha="center", va="center", color=FAINT)
                    continue
                mean, std, _ = row.spreads[column.name]
                color = BEST if y in top else PLAIN
                seeds = row.by_seed(column.name)
                axes.scatter(seeds, [y + 0.25] * len(seeds), s=16, facecolors="none", edgecolors=color, linewidths=0.9)
                axes.errorbar(mean, y, xerr=std, fmt="D", markersize=5, color=color, capsize=3, linewidth=1.4)
            axes.set_title(textwrap.fill(column.heading, 26), fontsize=10, loc="left")
            axes.grid(axis="x", alpha=0.25)
            axes.xaxis.set_major_locator(MaxNLocator(3))
            axes.tick_params(axis="x", labelsize=8)
            axes.tick_params(axis="y", labelsize=9, length=0)
            axes.spines[["top", "right", "left"]].set_visible(False)
        panels[0].set_yticks(range(len(shown)), [row.label for row in shown])
        panels[0].set_ylim(len(shown) - 0.5, -0.5)
    else:
        figure.text(0.5, 0.5, "no cell is finished yet", ha="center", color=FAINT)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Source": source} if source else None)
    return buffer.getvalue()
