"""Curves of metrics over the predicted frames: the mean over clips at each frame, with a bootstrap band."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import TypeAlias

import numpy as np

from rsjax.evaluation.registry import Metric, PerFrame, Scene, Unavailable, metrics
from rsjax.evaluation.statistics import bootstrap

# As in curves.json: "frame" holds the numbers of the predicted frames, counted from 1. The other keys are named as in
# metrics.json (psnr, psnr_low, psnr_high, psnr_repeat_first, …) and hold one number per predicted frame, None where no
# clip has a score.
Curves: TypeAlias = dict[str, list[float | None]]
RESAMPLES = 2000  # bootstrap resamples of the clips at each frame


def frame_curves(scenes: Mapping[str, Scene]) -> Curves:
    """Returns the curves of all metrics that score single frames, for every scene; ``scenes`` is keyed by suffix."""
    prompt, frames = scenes[""].prompt_frames, scenes[""].truth.rgb.shape[1]
    curves: Curves = {"frame": list(range(prompt + 1, frames + 1))}
    for metric in metrics().values():
        for suffix, per_frame in _scored(metric, scenes):
            curves |= _curve(f"{metric.name}{suffix}", metric, per_frame)
    return curves


def _scored(metric: Metric, scenes: Mapping[str, Scene]) -> Iterator[tuple[str, PerFrame]]:
    if metric.per_frame is None:
        return
    for suffix, scene in scenes.items():
        if not scene.alternatives.keys() >= set(metric.needs):
            continue  # a baseline has no videos under other actions
        with suppress(Unavailable):
            yield suffix, scene.shared(metric.per_frame)


def _curve(name: str, metric: Metric, per_frame: PerFrame) -> Curves:
    """Returns a curve and both edges of its band; at each frame, clips without a score do not count."""
    curve: Curves = {name: [], f"{name}_low": [], f"{name}_high": []}
    for values in np.asarray(per_frame).T:
        known = values[np.isfinite(values)]
        at = bootstrap(known, resamples=RESAMPLES, statistic=metric.statistic).flat(name) if known.size else {}
        for key, points in curve.items():
            points.append(at.get(key))
    return curve
