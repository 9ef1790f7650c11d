"""The files of weights that metrics need: checked before hours of work, and known by their content.

The network that estimates depth is one of :mod:`rsjax.tools.ingest`, adapted to what an evaluation calls.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from rsjax.config import SIMULATOR, ConfigError, EvalConfig, require
from rsjax.evaluation import evaluate as evaluation
from rsjax.evaluation.depth_estimator import DepthEstimator, DepthMaps
from rsjax.evaluation.metrics import fvd
from rsjax.evaluation.metrics.lpips import FILES
from rsjax.files import content_hash
from rsjax.tools.ingest.annotators.choose import choose
from rsjax.tools.ingest.annotators.depth import inverse_of
from rsjax.tools.ingest.annotators.network import CHECKOUT
from rsjax.tools.ingest.episode import Episode
from rsjax.tools.ingest.pictures import ArrayFrames

_CAMERA = "rgb"


def check_metric_files(settings: EvalConfig) -> None:
    """Checks all weight files and the depth estimator, so that a run does not fail after hours of training.

    Raises:
        UserError: a file is missing, damaged or of another network, or there is no such depth estimator.
    """
    evaluation.check_files(settings)
    _annotator(settings)


def load_estimator(settings: EvalConfig) -> DepthEstimator | None:
    """Loads the network that ``eval.depth_estimator`` names; returns None if it names none.

    The estimator that learns from a run's clips is made by :mod:`rsjax.tools.pipeline.depth_stage`.

    Raises:
        ConfigError: there is no such network or field, or a file that the setting names is missing.
        AnnotationError: the network cannot be loaded: a package or a device is missing, or a file is damaged.
    """
    annotator = _annotator(settings)
    if annotator is None:
        return None
    annotator.load()
    return Estimator(annotator)


@dataclass(frozen=True)
class Estimator:
    """A depth annotator of episodes, which takes a video's frames instead.

    Attributes:
        annotator: one of :mod:`rsjax.tools.ingest.annotators.depth`. It raises AnnotationError if it cannot run, or
            gives values that are not finite.
    """

    annotator: Any

    def __call__(self, frames: UInt8[np.ndarray, "T H W 3"]) -> DepthMaps:
        """Estimates the depth of a video's frames."""
        count = len(frames)
        episode = Episode(
            id="evaluation",
            fingerprint="",
            task="",
            fps=1.0,  # has no effect on depth
            timestamps=np.arange(count, dtype=np.float64),
            actions=np.zeros((count, 0), np.float32),
            states=None,
            cameras={_CAMERA: ArrayFrames(frames)},
        )
        depth = self.annotator(episode, _CAMERA)
        if depth.unit == "metres":
            return DepthMaps(depth.maps.read(range(count)), "metres", depth.extent)
        return DepthMaps(inverse_of(depth, range(count)), "relative 1/depth", depth.extent)


def _annotator(settings: EvalConfig) -> Any:
    """Returns the annotator that ``eval.depth_estimator`` names, not yet loaded; None if it names no network."""
    if not settings.depth_estimator or settings.simulator_steps:
        return None
    try:
        annotator = choose("depth", settings.depth_estimator)
        require(callable(annotator), f"{settings.depth_estimator!r} is not a network; choose one of docs/annotate.md")
        for name, value in vars(annotator).items():
            require(not isinstance(value, Path) or value.exists(), f"{name} {value} does not exist; mend the path")
    except ConfigError as error:
        raise ConfigError(f"eval.depth_estimator: {error}") from error
    return annotator


def by_content(settings: EvalConfig) -> EvalConfig:
    """Returns the settings with hashes of the files of weights in place of their directory.

    The depth estimator becomes the network's name and all its fields. In a checkout, which may contain other files
    than code, only Python files count.

    Raises:
        UserError: a file cannot be read.
    """
    files = {name: settings.weights_file(name) for name in (*FILES.values(), fvd.FILE)}
    weights = [f"{name}:{content_hash(Path(path))}" for name, path in files.items() if path]
    hashes: dict[str, Any] = {"weights": ",".join(weights)}
    if settings.simulator_steps:
        hashes["depth_estimator"] = f"{SIMULATOR}:steps={settings.simulator_steps}"
    annotator = _annotator(settings)
    if annotator is not None:
        fields = []
        for name, value in vars(annotator).items():
            if isinstance(value, Path):
                value = content_hash(value, "*.py" if name == CHECKOUT else "*")
            fields.append(f"{name}={value}")
        hashes["depth_estimator"] = f"{settings.depth_estimator.partition(':')[0]}:{','.join(fields)}"
    return replace(settings, **hashes)
