"""Draws scores as inline SVG: curves over the predicted frames, sorted errors of places, and what became of probes."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from rsjax.evaluation.metrics import contact
from rsjax.evaluation.registry import Metric
from rsjax.evaluation.results import Curves
from rsjax.tools.studies.report.curves import INK, LINE, Chart, charts_svg

# What is scored, by the suffix of a score's name.
SCENES = {
    "": "prediction",
    "_repeat_first": "first frame repeated",
    "_tokenizer": "tokenizer's reconstruction",
}
PLACE_SCENES = SCENES | {"_truth": "true frames (the reading network's own error)"}
_COLORS = {"": LINE, "_repeat_first": "#d9822b", "_tokenizer": "#3f9a63", "_truth": INK}
_DASHES = {"": "-", "_repeat_first": "--", "_tokenizer": "-.", "_truth": ":"}

_LEAST_ERROR = 0.01  # widths of the cube; smaller errors are drawn at this value, since the scale is logarithmic


def frame_curves_svg(curves: Curves, metrics: Sequence[Metric]) -> str:
    """Draws one chart per metric that has curves, with a line and a band per scene; returns "" if no metric has any."""
    charts = [_curve_chart(curves, metric) for metric in metrics if metric.name in curves]
    return charts_svg(charts, "scores frame by frame", legend=True) if charts else ""


def place_errors_svg(per_clip: Mapping[str, Sequence[float]], metrics: Sequence[Metric]) -> str:
    """Draws each metric's errors in widths of the cube, from the best clip to the worst; returns "" without errors."""
    charts = [_sorted_chart(per_clip, metric) for metric in metrics if metric.name in per_clip]
    return charts_svg(charts, "errors of places", legend=True, height=2.3) if charts else ""


def probes_svg(curves: Curves, metrics: Sequence[Metric]) -> str:
    """Draws the metrics of drives frame by frame, and success over the offset of grasps; returns "" without probes."""
    if contact.AXIS not in curves:
        return ""
    charts = [_curve_chart(curves, metric) for metric in metrics if metric.name in curves]

    def draw_offsets(axes: Axes) -> None:
        offsets = _numbers(curves[contact.AXIS])
        for suffix, (name, label) in {"_truth": (contact.SIMULATOR, "simulator"), "": (contact.MODEL, "model")}.items():
            low, high = (_numbers(curves[f"{name}_{side}"]) for side in ("low", "high"))
            color = _COLORS[suffix]
            axes.plot(offsets, _numbers(curves[name]), _DASHES[suffix], color=color, linewidth=1.3, label=label)
            axes.fill_between(offsets, low, high, color=color, alpha=0.18, linewidth=0)
        axes.set_ylim(-0.02, 1.02)
        axes.set_title("share of grasps that succeed", fontsize=9, loc="left")
        axes.set_xlabel("offset of the fingers from the cube, cm", fontsize=8)
        axes.legend(fontsize=8, frameon=False)

    return charts_svg([*charts, draw_offsets], "drives and grasps", legend=True, height=2.3)


def _curve_chart(curves: Curves, metric: Metric) -> Chart:
    def draw(axes: Axes) -> None:
        frames = _numbers(curves[metric.axis])
        for suffix, label in SCENES.items():
            name = f"{metric.name}{suffix}"
            if name not in curves:
                continue
            low, high = (_numbers(curves[f"{name}_{side}"]) for side in ("low", "high"))
            marker = "o" if len(frames) == 1 else None
            line = _numbers(curves[name])
            dash = _DASHES[suffix]
            color = _COLORS[suffix]
            axes.plot(frames, line, linestyle=dash, marker=marker, color=color, linewidth=1.3, label=label)
            axes.fill_between(frames, low, high, color=color, alpha=0.18, linewidth=0)
        axes.set_title(metric.heading, fontsize=9, loc="left")
        axes.set_xlabel("frame", fontsize=8)
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))

    return draw


def _sorted_chart(per_clip: Mapping[str, Sequence[float]], metric: Metric) -> Chart:
    def draw(axes: Axes) -> None:
        for suffix, label in PLACE_SCENES.items():
            errors = np.sort(per_clip.get(f"{metric.name}{suffix}", ()))
            if errors.size:
                share = 100 * (np.arange(errors.size) + 0.5) / errors.size
                shown = np.maximum(errors, _LEAST_ERROR)
                axes.plot(share, shown, _DASHES[suffix], color=_COLORS[suffix], label=label, linewidth=1.3)
        axes.set(yscale="log", xlim=(0, 100))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_title(metric.heading, fontsize=9, loc="left")
        axes.set_xlabel("% of the clips, best first", fontsize=8)

    return draw


def _numbers(values: Sequence[float | None]) -> np.ndarray:
    return np.array(values, float)  # None becomes NaN, a gap
