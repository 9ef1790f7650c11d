"""Computes the scores of all metrics over clips, over repetitions, and for the best of several samples.

Axes: B clips.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from rsjax.clip import Video
from rsjax.config import EvalConfig
from rsjax.evaluation.frame_curves import Curves
from rsjax.evaluation.protocols import Protocol
from rsjax.evaluation.registry import Metric, PerClip, Scene, Unavailable, metrics
from rsjax.evaluation.scenes import scaled
from rsjax.evaluation.statistics import bootstrap

PIXELS = ("psnr", "ssim", "lpips_alex", "lpips_vgg")  # metrics that are also reduced to the best of several samples


@dataclass(frozen=True)
class Scored:
    """The clips' scores, and the reasons for missing scores.

    Attributes:
        values: metric → name in metrics.json → each clip's score, or one score of the whole set as an array without
            axes; for the prediction and for both baselines.
        reasons: why a registered metric has no score, by name.
        best: scores of the best of several samples, by name.
    """

    values: Mapping[str, Mapping[str, PerClip]]
    reasons: dict[str, str]
    best: Mapping[str, PerClip]

    def per_clip(self) -> dict[str, PerClip]:
        """Returns the clips' scores by name, without scores of the whole set."""
        every = [(name, each) for values in self.values.values() for name, each in values.items()]
        return {name: each for name, each in (*every, *self.best.items()) if each.ndim}


def score_all(scenes: Mapping[str, Scene], protocol: Protocol, takes_actions: bool = True) -> Scored:
    """Scores the prediction and both baselines with all registered metrics.

    Args:
        takes_actions: False for a model without actions, which metrics that need other actions cannot score.
    """
    values, reasons = {}, {}
    for metric in metrics().values():
        try:
            if metric.needs and not takes_actions:
                raise Unavailable("the model takes no actions")
            values[metric.name] = _score(metric, scenes, protocol)
        except Unavailable as reason:
            reasons[metric.name] = str(reason)
    return Scored(values, reasons, {})


def _score(metric: Metric, scenes: Mapping[str, Scene], protocol: Protocol) -> dict[str, PerClip]:
    """Returns a metric's scores of the prediction and of both baselines, by name.

    Raises:
        Unavailable: the prediction cannot be scored. A baseline that cannot be scored is left out.
    """
    if not scenes[""].alternatives.keys() >= set(metric.needs):
        raise Unavailable(f"protocol {protocol.name} generates no videos under other actions")
    scores = _named(metric, scenes[""], "")
    if metric.needs:  # the first frame repeated ignores actions
        still = f"{metric.name}_repeat_first"
        return scores | {still + name.removeprefix(metric.name): np.zeros_like(each) for name, each in scores.items()}
    for suffix in filter(None, scenes):
        with suppress(Unavailable):
            scores |= _named(metric, scenes[suffix], suffix)
    return scores


def _named(metric: Metric, scene: Scene, suffix: str) -> dict[str, PerClip]:
    assert metric.function is not None
    scored = metric.function(scene)
    parts = scored if isinstance(scored, dict) else {"": scored}
    return {f"{metric.name}{suffix}{part}": np.asarray(per_clip) for part, per_clip in parts.items()}


def sample_scores(truth: Video, video: Video, protocol: Protocol, settings: EvalConfig) -> dict[str, PerClip]:
    """Scores one sample of each clip with the pixel metrics, over all frames: prompt frames as the model sees them."""
    scene, scores = Scene(truth, scaled(video, protocol.resolution), 0, settings=settings), {}
    for name in PIXELS:
        with suppress(Unavailable):
            scores[name] = _named(metrics()[name], scene, "")[name]
    return scores


def with_best(scored: Scored, scene: Scene, samples: Sequence[Mapping[str, PerClip]], protocol: Protocol) -> Scored:
    """Adds the best score over all samples for each pixel metric; adds nothing if there is only one sample.

    ``NAME_best100_incl_ctx`` takes each clip's best sample separately for each metric, over all frames, as iVideoGPT
    does; ``NAME_n1_pred_only`` is the first sample's score over the predicted frames only.

    Args:
        scene: with the first sample as its prediction.
        samples: the scores of the further samples.
    """
    if not samples:
        return scored
    first = sample_scores(scene.truth, scene.prediction, protocol, scene.settings)
    best = {}
    for name, values in first.items():
        reduce = np.max if metrics()[name].better == "higher" else np.min
        everything = np.stack([values, *(sample[name] for sample in samples)])
        best[f"{name}_best{len(everything)}_incl_ctx"] = reduce(everything, axis=0)
        best[f"{name}_n1_pred_only"] = scored.values[name][name]
    return Scored(scored.values, scored.reasons, best)


def mean_scores(repetitions: Sequence[Scored]) -> Scored:
    """Returns each clip's mean scores over repetitions with different random draws."""
    if len(repetitions) == 1:
        return repetitions[0]

    def mean(maps: Sequence[Mapping[str, PerClip]]) -> dict[str, PerClip]:
        return {name: np.mean([each[name] for each in maps], axis=0) for name in maps[0]}

    values = {name: mean([each.values[name] for each in repetitions]) for name in repetitions[0].values}
    return Scored(values, repetitions[0].reasons, mean([each.best for each in repetitions]))


def mean_curves(repetitions: Sequence[Curves]) -> Curves:
    """Returns the mean of curves over repetitions, point by point; a band's edges are the means of the edges."""
    if len(repetitions) == 1:
        return repetitions[0]
    return {
        name: [_mean(points) for points in zip(*(each[name] for each in repetitions), strict=True)]
        for name in repetitions[0]
    }


def _mean(points: Sequence[float | None]) -> float | None:
    known = [point for point in points if point is not None]
    return float(np.mean(known)) if known else None


def summarised(scored: Scored, interval: bool = True) -> dict[str, float]:
    """Returns each score's mean or median over clips by name, and its interval as ``NAME_low`` and ``NAME_high``."""
    flat: dict[str, float] = {}
    for metric in (metrics()[name] for name in scored.values):
        for name, values in scored.values[metric.name].items():
            if not values.ndim:  # one number for all clips
                flat[name] = float(values)
                continue
            estimate = bootstrap(values, statistic=metric.statistic)
            flat |= estimate.flat(name) if metric.interval and interval else {name: estimate.value}
    for name, values in scored.best.items():
        estimate = bootstrap(values)
        flat |= estimate.flat(name) if interval else {name: estimate.value}
    return flat
