"""The registry of metrics, from which evaluation, report and tables take each metric and its format.

A metric is a function in a file under ``rsjax/evaluation/metrics``, registered by :func:`metric`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from rsjax.clip import Video
from rsjax.config import ConfigError, EvalConfig
from rsjax.evaluation.statistics import Statistic
from rsjax.models.base import TeacherForced

PerClip: TypeAlias = Float[np.ndarray, " B"]  # clips may be left out if the truth alone decides that they have no score
PerFrame: TypeAlias = Float[np.ndarray, "B P"]  # P predicted frames; NaN where a frame has no score
Score: TypeAlias = PerClip | float  # one score per clip, or one for the whole set of clips
Scores: TypeAlias = Score | dict[str, Score]  # a dict has several scores by suffix; "" is the metric itself
# Videos generated under another clip's actions, or under uniform random actions.
Need = Literal["other", "uniform"]
T = TypeVar("T")


class Unavailable(Exception):
    """A metric cannot be computed. The message is the reason that metrics.json and the tables give for its absence."""


@dataclass(frozen=True)
class EstimatedDepth:
    """Depth of B clips that one estimator computed from frames.

    Attributes:
        truth: of the recorded frames, > 0, in metres or relative (see :func:`rsjax.data.depth_color.stretch`).
        prediction: of the generated frames, in the same unit.
        metres: whether this unit is metres.
        baseline: whether the frames are a baseline's, so that the error on the recorded frames is already scored.
    """

    truth: Float[np.ndarray, "B T H W"]
    prediction: Float[np.ndarray, "B T H W"]
    metres: bool = False
    baseline: bool = False


@dataclass(frozen=True)
class Places:
    """The places of cube and gripper in the last frames of B clips, or in any frames.

    Attributes:
        xy: x (right) and y (down) of cube and gripper; 0 and 1 are the image's edges, and points outside are clipped.
        lifted: whether the cube is lifted.
    """

    xy: Float[np.ndarray, "*B 2 2"]
    lifted: Bool[np.ndarray, "*B"]


@dataclass(frozen=True)
class Located:
    """Places in the last frames of B clips: the true places, and those that a network reads from the pictures.

    Attributes:
        truth: as the simulator recorded them.
        width: the cube's width in the unit of ``xy``.
        on_truth: what the network reads from the recorded frames; None in the scenes of baselines.
        prediction: what the network reads from the generated frames.
    """

    truth: Places
    width: Float[np.ndarray, " B"]
    on_truth: Places | None
    prediction: Places

    def read(self) -> dict[str, Places]:
        """Returns the places that the network read, by suffix of the metrics' names."""
        return {"": self.prediction} | ({"_truth": self.on_truth} if self.on_truth else {})


@dataclass(frozen=True)
class Grasps:
    """Grasps at set offsets between fingers and cube: how each ends in the simulator, and how it looks in a scene.

    Attributes:
        offset: horizontal distance from the cube's centre to where the fingers close, metres.
        success: whether the cube is lifted at the end, as the simulator says.
        on_truth: the probability of success that a network reads from the simulator's last frame; None in the scenes of
            baselines.
        prediction: the same from the scene's last frame, under the same first frames and actions.
    """

    offset: Float[np.ndarray, " G"]
    success: Bool[np.ndarray, " G"]
    on_truth: Float[np.ndarray, " G"] | None
    prediction: Float[np.ndarray, " G"]

    def read(self) -> dict[str, Float[np.ndarray, " G"]]:
        """Returns the probabilities of success that the network read, by suffix of the metrics' names."""
        return {"": self.prediction} | ({} if self.on_truth is None else {"_truth": self.on_truth})


@dataclass(frozen=True)
class Drives:
    """Free drives of the arm in the simulator and in a scene, under the same first frames and actions.

    Attributes:
        gripper: its true place in each frame, as in :class:`Places`.
        width: the cube's width in the unit of ``gripper``.
        on_truth: its place as a network reads it from the simulator's frames; None in the scenes of baselines.
        located: the same from the scene's frames.
    """

    truth: Video
    prediction: Video
    gripper: Float[np.ndarray, "D T 2"]
    width: Float[np.ndarray, " D"]
    on_truth: Float[np.ndarray, "D T 2"] | None
    located: Float[np.ndarray, "D T 2"]


@dataclass(frozen=True)
class Probed:
    """The outcomes of simulated probes in a scene."""

    grasps: Grasps
    drives: Drives


NO_PROBES = Unavailable("no grasps and drives were simulated for this evaluation")


@dataclass(frozen=True)
class Familiarity:
    """The distances of B clips' states and actions from the training clips (:mod:`rsjax.evaluation.coverage`).

    Attributes:
        coverage: the distance, where 1 is that of the median training clip from the others.
        percentile: the share of training clips that are nearer to the others, 0 to 1.
    """

    coverage: Float[np.ndarray, " B"]
    percentile: Float[np.ndarray, " B"]


@dataclass(frozen=True, eq=False)
class Scene:
    """Inputs of a metric: B clips, of which the first ``prompt_frames`` frames are the prompt.

    Attributes:
        truth: the recorded clips, with depth where it is in metres.
        prediction: videos generated under the clips' own actions.
        alternatives: videos generated under other actions, by kind; one for each draw of actions.
        estimated: depth estimated from the frames; None without an estimator.
        located: where cube and gripper are in the last frame; None if the clips do not record it.
        teacher_forced: how well the model predicts each frame's tokens; None for a baseline or a model without tokens.
        familiarity: how far the recorded clips are from the training clips; None: not measured, or a baseline.
        second_take: the same scenes recorded once more (same start, same task), for Physics-IQ's score.
        probed: grasps at set offsets and free drives, or why there are none.
        as_published: whether Physics-IQ's masks go through a lossy video, as in its public code.
        settings: the settings of the evaluation, with the paths of weights.
        truth_cache: what :meth:`of_truth` has computed; scenes with the same truth share it.
    """

    truth: Video
    prediction: Video
    prompt_frames: int = 1
    alternatives: Mapping[str, Sequence[Video]] = field(default_factory=dict)
    estimated: EstimatedDepth | None = None
    located: Located | None = None
    teacher_forced: TeacherForced | None = None
    familiarity: Familiarity | None = None
    second_take: Video | None = None
    probed: Probed | Unavailable = NO_PROBES
    as_published: bool = False
    settings: EvalConfig = field(default_factory=EvalConfig)
    truth_cache: dict[Any, Any] = field(default_factory=dict, repr=False)
    _shared: dict[Any, Any] = field(default_factory=dict, init=False, repr=False)

    @property
    def grasps(self) -> Grasps:
        """The grasps at set offsets; raises :class:`Unavailable` without any."""
        return self._probed.grasps

    @property
    def drives(self) -> Drives:
        """The free drives; raises :class:`Unavailable` without any."""
        return self._probed.drives

    @property
    def _probed(self) -> Probed:
        if isinstance(self.probed, Unavailable):
            raise self.probed
        return self.probed

    def shared(self, function: Callable[..., T], *arguments: Any) -> T:
        """Returns ``function(self, *arguments)``, computed once for all metrics that call it."""
        return _once(self._shared, function, self, arguments)

    def of_truth(self, function: Callable[..., T], *arguments: Any) -> T:
        """Returns ``function(self, *arguments)``, which reads only the truth; computed once per truth."""
        return _once(self.truth_cache, function, self, arguments)


def _once(cache: dict[Any, Any], function: Callable[..., T], scene: Scene, arguments: tuple[Any, ...]) -> T:
    key = (function, *arguments)
    if key not in cache:
        cache[key] = function(scene, *arguments)
    result: T = cache[key]
    return result


@dataclass(frozen=True)
class Metric:
    """A registered metric.

    Attributes:
        name: its key in metrics.json.
        title: its name in tables.
        unit: such as "dB"; empty for a pure number.
        better: whether higher or lower values are better.
        decimals: digits after the decimal point.
        needs: videos that it needs in addition to the prediction.
        watch: whether it is also computed during training.
        interval: whether its bootstrap interval is reported.
        statistic: how the clips' scores are summarised.
        column: whether tables have a column for it.
        axis: the entry of curves.json over which the metric's curve runs.
        function: scores a scene, with one number per clip or one for all clips, or raises :class:`Unavailable`; None
            for a number that is not computed from videos.
        per_frame: scores every predicted frame of a scene, or raises :class:`Unavailable`; None for a metric without a
            curve over frames.
    """

    name: str
    title: str
    unit: str
    better: Literal["higher", "lower"]
    decimals: int
    needs: tuple[Need, ...] = ()
    watch: bool = False
    interval: bool = True
    statistic: Statistic = "mean"
    column: bool = True
    axis: str = "frame"
    function: Callable[[Scene], Scores] | None = None
    per_frame: Callable[[Scene], PerFrame] | None = None

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
    statistic: Statistic = "mean",
    column: bool = True,
    axis: str = "frame",
    per_frame: Callable[[Scene], PerFrame] | None = None,
) -> Callable[[Callable[[Scene], Scores]], Callable[[Scene], Scores]]:
    """Registers a function as a metric; the arguments are the fields of :class:`Metric`.

    Raises:
        ConfigError: another metric already has that name.
    """

    def register(function: Callable[[Scene], Scores]) -> Callable[[Scene], Scores]:
        if name in _METRICS:
            raise ConfigError(f"two metrics are named {name!r}; rename one of them")
        settings = (name, title, unit, better, decimals, needs, watch, interval, statistic, column, axis)
        _METRICS[name] = Metric(*settings, function, per_frame)
        return function

    return register


def metrics() -> dict[str, Metric]:
    """Returns all registered metrics by name, in the order of tables: frames, depth, actions, then others."""
    import rsjax.evaluation.metrics  # noqa: F401 - registers the built-in metrics

    depth = [name for name in _METRICS if name.startswith("depth_")]
    first = ("psnr", "psnr_motion", "ssim", "lpips_alex", "lpips_vgg", *depth, "delta_psnr", "delta_psnr_uniform")
    return {name: _METRICS[name] for name in (*first, *(name for name in _METRICS if name not in first))}
