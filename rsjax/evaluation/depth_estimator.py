"""Estimates depth from recorded and generated frames by one network, so that models without depth have depth scores."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.data.depth_color import stretch
from rsjax.evaluation.registry import EstimatedDepth
from rsjax.progress import Progress


@dataclass(frozen=True)
class DepthMaps:
    """The depth of one video's frames, as a network estimates it.

    Attributes:
        maps: z-depth in metres, or 1/depth up to an unknown scale and shift; see ``unit``.
        unit: of ``maps``.
        extent: the video's least and greatest value, in the same unit.
    """

    maps: Float32[np.ndarray, "T H W"]
    unit: Literal["metres", "relative 1/depth"]
    extent: tuple[float, float]


# Estimates the depth of a video's frames, (T, H, W, 3); raises a UserError if the network cannot run.
DepthEstimator: TypeAlias = Callable[[UInt8[np.ndarray, "T H W 3"]], DepthMaps]


def estimate_depth(
    estimator: DepthEstimator,
    truth: UInt8[np.ndarray, "B T H W 3"],
    predictions: Mapping[str, UInt8[np.ndarray, "B T H W 3"]],
) -> dict[str, EstimatedDepth]:
    """Estimates the depth of recorded clips, and of each kind of video that was generated for them.

    Some networks estimate 1/depth only up to a scale and a shift, which are arbitrary. Their output for both videos of
    a clip is therefore stretched by the same map: to 1 at the recorded video's nearest point and 10 at its farthest.

    Args:
        predictions: by the suffix of the scores' names; "" is the model's own prediction.
    """
    recorded = np.empty(truth.shape[:-1], np.float32)
    generated = {name: np.empty_like(recorded) for name in predictions}
    units = set()
    with Progress("depth estimation", len(truth) * (1 + len(predictions)), "videos") as progress:
        for clip, frames in enumerate(truth):
            reference = estimator(frames)
            units.add(reference.unit)
            recorded[clip] = _in_unit_of(reference, reference)
            for name, videos in predictions.items():
                generated[name][clip] = _in_unit_of(reference, estimator(videos[clip]))
            progress.update((clip + 1) * (1 + len(predictions)))
    metres = units == {"metres"}
    return {name: EstimatedDepth(recorded, depth, metres, baseline=name != "") for name, depth in generated.items()}


def _in_unit_of(reference: DepthMaps, depth: DepthMaps) -> Float32[np.ndarray, "T H W"]:
    """Returns the maps in metres, or relative depth stretched by the same map as the reference."""
    if depth.unit == "metres":
        return depth.maps
    return stretch(depth.maps, reference.extent)
