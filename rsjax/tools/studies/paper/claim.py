"""A claim as data: what is trained for it, what is compared, and what the paper reports."""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from rsjax.config import require
from rsjax.errors import did_you_mean

# The margins within which two scores count as equal, by metric, in its unit; chosen before they were used.
EQUAL = {
    "psnr": 0.1,
    "psnr_motion": 0.1,
    "delta_psnr": 0.1,
    "delta_psnr_uniform": 0.1,
    "ssim": 0.005,
    "lpips_alex": 0.005,
    "depth_absrel": 0.002,
    "cube_error_widths": 0.05,
    "gripper_error_widths": 0.05,
    "physics_iq_spatial": 0.01,
    "physics_iq_spatiotemporal": 0.01,
    "physics_iq_weighted": 0.01,
    "physics_iq_mse": 0.0005,
}


@dataclass(frozen=True)
class Arm:
    """One of the trainings that a claim compares; it runs with several seeds.

    An arm without settings is the base preset itself.

    Attributes:
        name: its name in tables.
        values: fields that differ from the base preset, by dotted name.
        model: the family of the model, at the base preset's size; empty: the base preset's family.
        preset: a family whose small preset is used instead (``irasim``: ``irasim_tiny``), with the base preset's clips
            and evaluation. An arm whose preset does not exist is left out.
        equal: whether it trains for as many steps as the base preset, for as many estimated seconds, or for as many
            operations. A family's small preset trains autoencoder and model; both are scaled by the same factor.
        curriculum: the epochs of its training on each difficulty, in order; they are scaled to the cell's steps.
        mixed: mix the clips of these stages instead, each clip as often as in the curriculum.
        data: the share of the training clips that the world model learns from.
        annotations: the depth and tracks that the world model learns from
            (:attr:`rsjax.config.ComponentConfig.annotations`).
        rate: a factor on the learning rate of the world model.
        published: the paper's numbers for this arm, by metric.
    """

    name: str
    values: Mapping[str, Any] = field(default_factory=dict)
    model: str = ""
    preset: str = ""
    equal: Literal["steps", "seconds", "flops"] = "steps"
    curriculum: Mapping[str, float] = field(default_factory=dict)
    mixed: bool = False
    data: float = 1.0
    annotations: Literal["own", "estimated_tracks", "estimated_depth", "estimated"] = "own"
    rate: float = 1.0
    published: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ArmComparison:
    """A part of a claim: one arm scores better than another.

    Attributes:
        metric: a registered metric, which determines whether higher or lower is better.
        better, than: names of the arms; if both are the same arm, two of its scores are compared.
        score, than_score: the per-clip score of each arm, such as "psnr_repeat_first"; empty: the metric itself.
        measurement: the source of the scores: empty for the run's evaluation, otherwise the name of a
            :func:`rsjax.tools.studies.paper.measurements.measurement`.
        margin: by how much the first arm is better, in the metric's unit; negative: it is worse by at most ``-margin``.
        equal: the margin within which both count as equal, in the metric's unit; None: that of :data:`EQUAL`, if the
            metric has one; 0: equality is not tested.
    """

    metric: str
    better: str
    than: str
    score: str = ""
    than_score: str = ""
    measurement: str = ""
    margin: float = 0.0
    equal: float | None = None

    @property
    def equal_margin(self) -> float:
        """The margin within which both count as equal; 0 if equality is not tested."""
        return EQUAL.get(self.metric, 0.0) if self.equal is None else self.equal


@dataclass(frozen=True)
class Claim:
    """A statement of the paper, or about a choice of ours, that can be put to the test.

    Attributes:
        name: the name for ``--only``.
        title: a heading.
        statement: what is claimed, in the words of the source.
        place: the place in the paper, such as "Table 2".
        arms: what is trained. Arms with the same configuration are trained once for all claims.
        comparisons: the parts of the claim.
        shown: further metrics that the report shows for each arm, but does not compare.
        beside: further scores that the report shows for each arm: score → the measurement that it is from.
        rank: claims of rank 0 run first, with all their seeds; then the others by rank, each with two seeds; then
            their further seeds.
        notes: differences from the paper, one line each.
    """

    name: str
    title: str
    statement: str
    place: str
    arms: tuple[Arm, ...]
    comparisons: tuple[ArmComparison, ...]
    shown: tuple[str, ...] = ()
    beside: Mapping[str, str] = field(default_factory=dict)
    rank: int = 5
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        names = [arm.name for arm in self.arms]
        require(len(set(names)) == len(names), f"claim {self.name!r} has two arms of one name; rename one of them")
        for comparison in self.comparisons:
            for name in (comparison.better, comparison.than):
                require(name in names, f"claim {self.name!r} compares {name!r}, which is not one of its arms")

    @property
    def equal(self) -> Literal["steps", "seconds", "flops"]:
        """What is equal in the trainings of its arms: steps, unless an arm has equal seconds or operations."""
        return next((arm.equal for arm in self.arms if arm.equal != "steps"), "steps")

    def arm(self, name: str) -> Arm:
        """Returns the arm of this name."""
        return next(arm for arm in self.arms if arm.name == name)

    def measurements(self, arm: str) -> tuple[str, ...]:
        """Returns the names of the measurements of an arm that the claim's comparisons and report need."""
        used = (each.measurement for each in self.comparisons if arm in (each.better, each.than))
        return tuple(dict.fromkeys([*filter(None, used), *self.beside.values()]))


# The depth errors that models without depth have, too: an estimator's, by the protocol that the paper follows.
ESTIMATED_DEPTH = tuple(f"depth_{name}_median_estimator" for name in ("absrel", "delta1", "delta2"))
# An estimator's error in metres. Reports have it for the true frames too, where it is the estimator's own.
ESTIMATOR_ERROR = "depth_absrel_exact_estimator"


def pairs(better: str, than: str, *metrics: str) -> tuple[ArmComparison, ...]:
    """Returns comparisons of two arms, one for each of these metrics."""
    return tuple(ArmComparison(metric, better, than) for metric in metrics)


_CLAIMS: dict[str, Claim] = {}


def register(claim: Claim) -> Claim:
    """Adds a claim to those of ``rsjax paper``, and returns it.

    Raises:
        ConfigError: another claim has the same name.
    """
    require(claim.name not in _CLAIMS, f"two claims are named {claim.name!r}; rename one of them")
    _CLAIMS[claim.name] = claim
    return claim


def claims() -> dict[str, Claim]:
    """Returns all claims by name, in the order of their ranks and then of the files in ``claims/``."""
    import rsjax.tools.studies.paper.claims  # noqa: F401 - registers them

    return dict(sorted(_CLAIMS.items(), key=lambda item: item[1].rank))


def chosen(patterns: Sequence[str], known: Mapping[str, Claim]) -> tuple[Claim, ...]:
    """Returns the claims whose names match a shell pattern, or all of them if there is no pattern.

    Raises:
        ConfigError: a pattern matches no claim; the message lists all claims.
    """
    for pattern in patterns:
        problem = f"--only {pattern}: no such claim{did_you_mean(pattern, known)} (claims: {', '.join(known)})"
        require(any(fnmatch.fnmatchcase(name, pattern) for name in known), problem)
    names = (name for name in known if not patterns or any(fnmatch.fnmatchcase(name, each) for each in patterns))
    return tuple(known[name] for name in names)
