"""Draws small charts as inline SVG, among them training curves."""

import html
import io
import math
import re
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

Chart: TypeAlias = Callable[[Axes], None]

# Inches. Places are fixed, since to find them by the sizes of all labels would take longer than to draw.
_WIDTH = 11.6
_COLUMNS = 4
_LEFT = 0.6  # from here on: around the axes of a chart, for tick labels and titles
_RIGHT = 0.12
_BOTTOM = 0.4
_TOP = 0.4
_LEGEND = 0.3
INK = "#010203"  # placeholder for the page's text colour
LINE = "#3b7dd8"


def curves_svg(log: Sequence[dict[str, Any]], name: str) -> str:
    """Draws a small chart per scalar of a log, as :func:`charts_svg` does.

    Args:
        log: one dict per logged step, with "step"; its other numbers are drawn, and values that are not numbers are
            ignored. A scalar may be missing at some steps. Values that are not finite leave a gap.
        name: makes the element ids of several drawings on a page distinct.

    Raises:
        ValueError: the log contains no scalar.
    """
    names = list(dict.fromkeys(key for line in log for key, value in line.items() if _is_scalar(key, value)))
    names.sort(key=lambda key: (key != "loss", "loss" not in key))
    if not names:
        raise ValueError(f"the log of {name} has no scalar to draw")
    return charts_svg([_scalar_chart(log, key) for key in names], f"{name} curves")


def charts_svg(charts: Sequence[Chart], name: str, legend: bool = False, height: float = 1.9) -> str:
    """Draws charts, four per row, as one <svg> element that inherits the page's font and text colour.

    Args:
        charts: each draws into the axes that it gets; ``INK`` becomes the text colour.
        name: says what is drawn, and makes the element ids of several drawings on a page distinct.
        legend: draw one legend above the charts, with the labels of those that have none of their own.
        height: the height of a row, in units in which the whole width is 11.6.
    """
    rows = math.ceil(len(charts) / _COLUMNS)
    width = _WIDTH / _COLUMNS
    whole = height * rows + _LEGEND * legend
    settings: dict[Any, Any] = {
        "svg.fonttype": "none",
        "svg.hashsalt": name,
        "font.size": 9,
        "font.family": "sans-serif",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.linewidth": 0.6,
    }
    settings |= dict.fromkeys(["text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"], INK)
    with matplotlib.rc_context(settings):
        figure = Figure(figsize=(_WIDTH, whole))
        for place, draw in enumerate(charts):
            row, column = divmod(place, _COLUMNS)
            left = (column * width + _LEFT) / _WIDTH
            bottom = ((rows - 1 - row) * height + _BOTTOM) / whole
            axes = figure.add_axes((left, bottom, (width - _LEFT - _RIGHT) / _WIDTH, (height - _BOTTOM - _TOP) / whole))
            axes.grid(alpha=0.18, linewidth=0.6, color=INK)
            draw(axes)
        if legend:
            handles: dict[str, Any] = {}
            for axes in filter(lambda axes: axes.get_legend() is None, figure.axes):
                for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                    handles.setdefault(label, handle)
            columns = len(handles)
            figure.legend(handles.values(), handles, loc="upper left", ncols=columns, frameon=False)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    head = rf'<svg \1 role="img" aria-label="{html.escape(name)}">'
    svg = re.sub(r'<svg [^>]*?(viewBox="[^"]*")[^>]*>', head, svg, count=1)
    return svg.replace(INK, "currentColor")


def _scalar_chart(log: Sequence[dict[str, Any]], key: str) -> Chart:
    points = [(line["step"], float(line[key])) for line in log if _is_scalar(key, line.get(key))]
    steps, values = zip(*points, strict=True)

    def draw(axes: Axes) -> None:
        axes.plot(steps, values, color=LINE, linewidth=1.3, marker="o" if len(points) == 1 else None)
        finite = [value for value in values if math.isfinite(value)]
        if finite and min(finite) > 0 and max(finite) / min(finite) > 30:
            axes.set_yscale("log")
        else:
            axes.ticklabel_format(axis="y", scilimits=(-3, 4))
        axes.set_title(f"{key}: {values[-1]:.4g}", fontsize=9, loc="left")

    return draw


def _is_scalar(key: str, value: Any) -> bool:
    return key != "step" and isinstance(value, (int, float)) and not isinstance(value, bool)
