"""A grid's table as a picture: a panel per metric, a line per combination of values."""

import io
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rsjax.ablation.table import Metric, Row, best, present

_PLAIN, _BEST, _FAINT = "#3b7dd8", "#d9480f", "#868e96"
_PANEL, _LINE = 2.3, 0.42  # inches: width of a panel, height of a line
_MOST_LINES = 150  # a picture taller than this would be refused by viewers


def draw(rows: Sequence[Row], title: str) -> bytes:
    """The picture, PNG. Circles are seeds; bars are the mean ± sample standard deviation; the best mean is orange."""
    metrics, shown = present(rows), rows[:_MOST_LINES]
    left = 0.075 * max(len(row.label) for row in shown)
    width, height = left + _PANEL * max(1, len(metrics)), 1.5 + _LINE * len(shown)
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, x=0.01, ha="left", fontsize=12)
    if not metrics:
        figure.text(0.5, 0.5, "no cell is finished yet", ha="center", color=_FAINT)
    panels = figure.subplots(1, len(metrics), sharey=True, squeeze=False)[0] if metrics else []
    for axes, metric in zip(panels, metrics, strict=True):
        _panel(axes, metric, rows, len(shown))
    if metrics:
        panels[0].set_yticks(range(len(shown)), [row.label for row in shown])
        panels[0].set_ylim(len(shown) - 0.5, -0.5)
    note = (
        "circles: seeds; bar: mean ± sample standard deviation; orange: best mean, which need not be more than chance"
    )
    figure.supxlabel(note, fontsize=8, color=_FAINT, x=0.01, ha="left")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _panel(axes: Axes, metric: Metric, rows: Sequence[Row], count: int) -> None:
    top = best(rows, metric)
    for y, row in enumerate(rows[:count]):
        spread = row.spreads.get(metric.key)
        if spread is None:
            axes.text(0.5, y, "–", transform=axes.get_yaxis_transform(), ha="center", va="center", color=_FAINT)
            continue
        color = _BEST if y in top else _PLAIN
        seeds = [result.metrics[metric.key] for result in row.finished if metric.key in result.metrics]
        axes.scatter(seeds, [y + 0.25] * len(seeds), s=16, facecolors="none", edgecolors=color, linewidths=0.9)
        axes.errorbar(spread.mean, y, xerr=spread.std, fmt="D", markersize=5, color=color, capsize=3, linewidth=1.4)
    axes.set_title(metric.heading, fontsize=10, loc="left")
    axes.grid(axis="x", alpha=0.25)
    axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.tick_params(axis="x", labelsize=8)
    axes.tick_params(axis="y", labelsize=9, length=0)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
