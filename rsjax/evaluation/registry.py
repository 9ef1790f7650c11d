"""The registry of metrics, from which evaluation, report and tables take each metric and its format.

A metric is a function in a file under ``rsjax/evaluation/metrics``, registered by :func:`metric`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float

from rsjax.clip import Video
from rsjax.config import ConfigError

PerClip: TypeAlias = Float[np.ndarray, " B"]
Scores: TypeAlias = PerClip | dict[str, PerClip]  # a dict has several scores by suffix; "" is the metric itself
# Depth in metres; videos generated under another clip's actions, or under uniform random actions.
Need = Literal["depth", "other", "uniform"]


@dataclass(frozen=True)
class Scene:
    """Inputs of a metric: B clips, of which the first ``prompt_frames`` frames are the prompt.

    Attributes:
        truth: the recorded clips.
        prediction: videos generated under their own actions.
        alternatives: videos generated under other actions, by kind; one for each draw of actions.
    """

    truth: Video
    prediction: Video
    prompt_frames: int = 1
    alternatives: Mapping[str, Sequence[Video]] = field(default_factory=dict)


@dataclass(frozen=True)
class Metric:
    """A registered metric.

    Attributes:
        name: its key in metrics.json.
        title: its name in tables.
        unit: such as "dB"; empty for a pure number.
        better: whether higher or lower values are better.
        decimals: digits after the decimal point.
        needs: data that it needs beside frames.
        watch: whether it is also computed during training.
        interval: whether its bootstrap interval is reported.
        function: scores a scene, one number per clip; None for a number that is not computed from videos.
    """

    name: str
    title: str
    unit: str
    better: Literal["higher", "lower"]
    decimals: int
    needs: tuple[Need, ...] = ()
    watch: bool = False
    interval: bool = True
    function: Callable[[Scene], Scores] | None = None

    @property
    def heading(self) -> str:
        """The heading of a column: title, unit, and an arrow towards better values."""
        unit = f", {self.unit}" if self.unit else ""
        return f"{self.title}{unit} {'↑' if self.better == 'higher' else '↓'}"


_METRICS: dict[str, Metric] = {}


def metric(
    name: str,
    title: str,
    *,
    better: Literal["higher", "lower"],
    unit: str = "",
    decimals: int = 3,
    needs: tuple[Need, ...] = (),
    watch: bool = False,
    interval: bool = True,
) -> Callable[[Callable[[Scene], Scores]], Callable[[Scene], Scores]]:
    """Registers a function as a metric; the arguments are the fields of :class:`Metric`.

    Raises:
        ConfigError: another metric already has that name.
    """

    def register(function: Callable[[Scene], Scores]) -> Callable[[Scene], Scores]:
        if name in _METRICS:
            raise ConfigError(f"two metrics are named {name!r}; rename one of them")
        _METRICS[name] = Metric(name, title, unit, better, decimals, needs, watch, interval, function)
        return function

    return register


def metrics() -> dict[str, Metric]:
    """Returns all registered metrics by name, in the order of tables: frames, depth, actions, then others."""
    import rsjax.evaluation.metrics  # noqa: F401 - registers the built-in metrics

    first = ("psnr", "ssim", "depth_absrel", "depth_delta1", "depth_delta2", "delta_psnr", "delta_psnr_uniform")
    return {name: _METRICS[name] for name in (*first, *(name for name in _METRICS if name not in first))}
