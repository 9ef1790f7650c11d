"""Draws training curves as inline SVG."""

import html
import io
import math
import re
from collections.abc import Sequence
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

_COLUMNS = 4
_INK = "#010203"  # placeholder for the page's text colour
_LINE = "#3b7dd8"


def curves_svg(log: Sequence[dict[str, Any]], name: str) -> str:
    """Draws a small chart per scalar of a log, as one <svg> element that inherits the page's font and text colour.

    Args:
        log: one dict per logged step, with "step"; its other numbers are drawn, other values are ignored. A scalar may
            be missing at some steps. Values that are not finite leave a gap.
        name: makes the element ids of several drawings on a page distinct.

    Raises:
        ValueError: the log contains no scalar.
    """
    names = list(dict.fromkeys(key for line in log for key, value in line.items() if _is_scalar(key, value)))
    names.sort(key=lambda key: (key != "loss", "loss" not in key))
    if not names:
        raise ValueError(f"the log of {name} has no scalar to draw")
    rows = math.ceil(len(names) / _COLUMNS)
    settings: dict[Any, Any] = {
        "svg.fonttype": "none",
        "svg.hashsalt": name,
        "font.size": 9,
        "font.family": "sans-serif",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.linewidth": 0.6,
    }
    settings |= dict.fromkeys(["text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"], _INK)
    with matplotlib.rc_context(settings):
        figure = Figure(figsize=(11.6, 1.9 * rows), layout=ConstrainedLayoutEngine(h_pad=0.09))
        for place, key in enumerate(names, start=1):
            points = [(line["step"], float(line[key])) for line in log if _is_scalar(key, line.get(key))]
            _chart(figure.add_subplot(rows, _COLUMNS, place), key, points)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    head = rf'<svg \1 role="img" aria-label="{html.escape(name)} curves">'
    svg = re.sub(r'<svg [^>]*?(viewBox="[^"]*")[^>]*>', head, svg, count=1)
    return svg.replace(_INK, "currentColor")


def _chart(axes: Axes, key: str, points: list[tuple[float, float]]) -> None:
    steps, values = zip(*points, strict=True)
    axes.plot(steps, values, color=_LINE, linewidth=1.3, marker="o" if len(points) == 1 else None)
    finite = [value for value in values if math.isfinite(value)]
    if finite and min(finite) > 0 and max(finite) / min(finite) > 30:
        axes.set_yscale("log")
    else:
        axes.ticklabel_format(axis="y", scilimits=(-3, 4))
    axes.set_title(f"{key}: {values[-1]:.4g}", fontsize=9, loc="left")
    axes.grid(alpha=0.18, linewidth=0.6, color=_INK)


def _is_scalar(key: str, value: Any) -> bool:
    return key != "step" and isinstance(value, (int, float)) and not isinstance(value, bool)
