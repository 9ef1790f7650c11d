"""Draws the figures of the policy experiments as PNG, and joins videos side by side."""

import io
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure

from rsjax.evaluation.statistics import Estimate

COLORS = ("#3b7dd8", "#d9480f", "#2b8a3e", "#862e9c", "#868e96")
GAP = 4  # pixels between videos


def success_curves(series: Mapping[str, Sequence[tuple[float, Estimate]]], label: str = "demonstrations") -> bytes:
    """Returns a plot of success with its intervals, one line for each series of (x, share)."""
    figure = Figure(figsize=(5.5, 3.8), layout="constrained")
    axes = figure.subplots()
    for number, (name, points) in enumerate(series.items()):
        ordered = sorted(points, key=lambda point: point[0])
        x = np.array([point[0] for point in ordered])
        shares = [point[1] for point in ordered]
        axes.errorbar(
            x, _values(shares), yerr=_bars(shares), label=name, marker="o", capsize=3, color=COLORS[number % 5]
        )
    axes.set(xlabel=label, ylabel="success", ylim=(-0.03, 1.03))
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    return _png(figure)


def scatter(points: Mapping[str, tuple[Sequence[Estimate], Sequence[Estimate]]], titles: Mapping[str, str]) -> bytes:
    """Returns a panel for each world model: true success on x, imagined success on y, a cross for each policy."""
    figure = Figure(figsize=(3.8 * len(points), 4.4), layout="compressed")
    panels = figure.subplots(1, len(points), squeeze=False)[0]
    for axes, (name, (true, imagined)) in zip(panels, points.items(), strict=True):
        axes.plot([0, 1], [0, 1], color=COLORS[4], linewidth=0.8, linestyle="--")
        bars = {"xerr": _bars(true), "yerr": _bars(imagined)}
        axes.errorbar(_values(true), _values(imagined), fmt="o", color=COLORS[0], capsize=2, linewidth=0.9, **bars)
        axes.set(xlabel="success in the simulator", xlim=(-0.05, 1.05), ylim=(-0.05, 1.05), aspect="equal")
        axes.set_title(f"{name}\n{titles[name]}", fontsize=9)
        axes.grid(alpha=0.25)
    panels[0].set_ylabel("success in the world model")
    return _png(figure)


def side_by_side(videos: Sequence[UInt8[np.ndarray, "T S S 3"]]) -> UInt8[np.ndarray, "T2 S W 3"]:
    """Returns one video with the given videos side by side; shorter videos hold their last frame."""
    length = max(map(len, videos))
    gap = np.full((length, videos[0].shape[1], GAP, 3), 255, np.uint8)
    parts: list[np.ndarray] = []
    for video in videos:
        padded = np.concatenate([video, np.repeat(video[-1:], length - len(video), axis=0)])
        parts += [padded, gap]
    return np.concatenate(parts[:-1], axis=2)


def _values(shares: Sequence[Estimate]) -> list[float]:
    return [share.value for share in shares]


def _bars(shares: Sequence[Estimate]) -> Float[np.ndarray, "2 N"]:
    low = [share.value - (share.value if share.low is None else share.low) for share in shares]
    high = [(share.value if share.high is None else share.high) - share.value for share in shares]
    return np.maximum([low, high], 0.0)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()
