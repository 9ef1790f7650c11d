"""Estimates depth from recorded and generated frames by one network, so that models without depth have depth scores."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.config import ConfigError, EvalConfig, require
from rsjax.evaluation.registry import EstimatedDepth
from rsjax.files import content_hash
from rsjax.progress import Progress
from rsjax.tools.ingest.annotators.choose import choose
from rsjax.tools.ingest.annotators.depth import inverse_of, stretch
from rsjax.tools.ingest.annotators.protocols import DepthEstimator, DepthMaps
from rsjax.tools.ingest.episode import Episode
from rsjax.tools.ingest.pictures import ArrayFrames

_CAMERA = "rgb"


def choose_estimator(settings: EvalConfig, load: bool = False) -> DepthEstimator | None:
    """Returns the network that ``eval.depth_estimator`` names; None if the setting is empty.

    Args:
        load: load the network now, not at its first call.

    Raises:
        ConfigError: there is no such network or field, or a file that the setting names is missing.
        AnnotationError: the network cannot be loaded: a package or a device is missing, or a file is damaged.
    """
    if not settings.depth_estimator:
        return None
    try:
        estimator = choose("depth", settings.depth_estimator)
        require(callable(estimator), f"{settings.depth_estimator!r} is no network; choose one of docs/annotate.md")
        for name, value in vars(estimator).items():
            require(not isinstance(value, Path) or value.exists(), f"{name} {value} does not exist; mend the path")
    except ConfigError as error:
        raise ConfigError(f"eval.depth_estimator: {error}") from error
    if load:
        estimator.load()
    found: DepthEstimator = estimator
    return found


def by_content(settings: EvalConfig) -> str:
    """Returns the network's name and all its fields, with a hash of content for each file; "" without a network.

    In a checkout, which may contain other files than code, only Python files count. The errors are those of
    :func:`choose_estimator` and :func:`rsjax.files.content_hash`.
    """
    estimator = choose_estimator(settings)
    if estimator is None:
        return ""
    fields = []
    for name, value in vars(estimator).items():
        content = content_hash(value, "*.py" if name == "checkout" else "*") if isinstance(value, Path) else value
        fields.append(f"{name}={content}")
    return f"{settings.depth_estimator.partition(':')[0]}:{','.join(fields)}"


def estimate_depth(
    estimator: DepthEstimator,
    truth: UInt8[np.ndarray, "B T H W 3"],
    predictions: Mapping[str, UInt8[np.ndarray, "B T H W 3"]],
) -> dict[str, EstimatedDepth]:
    """Estimates the depth of recorded clips, and of each kind of video that was generated for them.

    Some networks estimate 1/depth only up to a scale and a shift, which are arbitrary. Their output for both videos of
    a clip is therefore stretched by the same map: to 1 at the recorded video's nearest point and 10 at its farthest.

    Raises:
        AnnotationError: the network cannot run, or gives values that are not finite.
    """
    recorded = np.empty(truth.shape[:-1], np.float32)
    generated = {name: np.empty_like(recorded) for name in predictions}
    with Progress("depth estimation", len(truth) * (1 + len(predictions)), "videos") as progress:
        done = 0
        for clip, frames in enumerate(truth):
            reference = estimator(_episode(frames, clip), _CAMERA)
            recorded[clip] = _like(reference, reference)
            for name, videos in predictions.items():
                generated[name][clip] = _like(estimator(_episode(videos[clip], clip), _CAMERA), reference)
            progress.update(done := done + 1 + len(predictions))
    return {name: EstimatedDepth(recorded, depth) for name, depth in generated.items()}


def _like(depth: DepthMaps, reference: DepthMaps) -> Float32[np.ndarray, "T H W"]:
    """Returns the maps in metres, or relative depth stretched by the same map as the reference."""
    frames = range(len(depth.maps))
    if depth.unit == "metres":
        return depth.maps.read(frames)
    return stretch(inverse_of(depth, frames), reference.extent)


def _episode(frames: UInt8[np.ndarray, "T H W 3"], clip: int) -> Episode:
    count = len(frames)
    return Episode(
        id=f"evaluation-{clip}",
        fingerprint="",
        task="",
        fps=1.0,  # has no effect on depth
        timestamps=np.arange(count, dtype=np.float64),
        actions=np.zeros((count, 0), np.float32),
        states=None,
        cameras={_CAMERA: ArrayFrames(frames)},
    )
