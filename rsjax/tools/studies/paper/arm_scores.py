"""What was measured of a claim's arms: all that the judge needs, from run directories or from a committed file."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rsjax.config import SimConfig
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.paper import budget
from rsjax.tools.studies.paper.claim import Claim
from rsjax.tools.studies.paper.measurements import Scores
from rsjax.tools.studies.paper.plan import Plan
from rsjax.tools.studies.results import RunResult, Spread, spread

ReadScores = Callable[[Run, str], tuple[Scores, str]]

CEILING = "psnr_tokenizer"  # PSNR of the reconstruction by each family's own autoencoder, a limit on the prediction's
# Suffixes of the scores of what a model is compared with. "_truth": what a network reads from the true frames, which is
# its own error.
BASELINES = ("_repeat_first", "_tokenizer", "_truth")
CLIP_DIGITS = 4  # significant digits of a clip's score, here as in the committed files
SEED_DIGITS = 6  # of a seed's


@dataclass(frozen=True)
class ScoreRows:
    """An arm's scores by one name.

    Attributes:
        rows: for each finished seed, one number per clip, NaN where a clip has no score; none if a seed lacks them.
        reason: why there are none.
    """

    rows: tuple[tuple[float, ...], ...] = ()
    reason: str = ""


@dataclass(frozen=True)
class ArmScores:
    """The measured scores of an arm.

    Attributes:
        name: the arm's name.
        planned: the number of trainings that it was meant to have.
        seeds: those of finished trainings.
        trainings: the names of the finished trainings' directories, which end with a content key.
        clips: a key of each finished training's test clips; they differ if the seed decides the clips too.
        numbers: by metric or name in ``Claim.beside``, the score of each finished seed over all clips; None without.
        scores: by measurement ("" for the run's own evaluation) and by name, the clips' scores.
        parameters: trained and frozen ones, in words.
        steps: of the world model; None with a curriculum, whose epochs decide them.
        tflop, minutes: of the training, autoencoder included.
        absent: why the arm cannot be trained; empty if it can.
        results: of all its trainings, finished or not; empty if the scores are from a file.
    """

    name: str
    planned: int
    seeds: tuple[int, ...]
    trainings: tuple[str, ...]
    clips: tuple[str, ...]
    numbers: Mapping[str, Sequence[float | None]]
    scores: Mapping[str, Mapping[str, ScoreRows]]
    parameters: str | None = None
    steps: int | None = None
    tflop: float | None = None
    minutes: float | None = None
    absent: str = ""
    results: tuple[RunResult, ...] = field(default=(), compare=False)

    @property
    def label(self) -> str:
        """The name of its line in a figure."""
        return self.name

    @property
    def spreads(self) -> dict[str, Spread]:
        """Mean and deviation over the seeds of every score that any of them has, by name."""
        return {name: spread(values) for name in self.numbers if (values := self.by_seed(name))}

    @property
    def finished(self) -> tuple[RunResult, ...]:
        """The results of finished trainings; empty if the scores are from a file."""
        return tuple(result for result in self.results if result.state == "finished")

    def by_seed(self, name: str) -> list[float]:
        """Returns the finished seeds' scores by this name, without seeds that lack it."""
        return [value for value in self.numbers.get(name, ()) if value is not None]


def read_arm(claim: Claim, name: str, plan: Plan, known: Mapping[str, RunResult], read: ReadScores) -> ArmScores:
    """Reads what has been measured so far of one of a claim's arms.

    Args:
        known: the result of each cell of the plan, by name.
        read: reads the clips' scores of a run: :func:`rsjax.tools.studies.paper.measurements.read_scores`, which claims
            that share trainings may cache.
    """
    cells = plan.of(claim.name, name)
    results = tuple(known[cell.name] for cell in cells)
    finished = [result for result in results if result.state == "finished"]
    # Scores over all clips: of the claim's metrics, of baselines, and those shown beside them.
    compared = dict.fromkeys([*(each.metric for each in claim.comparisons), *claim.shown])
    baselines = [f"{metric}{suffix}" for metric in compared for suffix in BASELINES]
    numbers: dict[str, list[float | None]] = {}
    for metric in dict.fromkeys([*compared, *baselines, CEILING]):
        numbers[metric] = [rounded(result.metrics.get(metric), SEED_DIGITS) for result in finished]
    for metric, source in claim.beside.items():
        measured = [read(result.run, source)[0].get(metric) for result in finished]
        numbers[metric] = [None if each is None else rounded(float(np.mean(each)), SEED_DIGITS) for each in measured]
    scores: dict[str, dict[str, ScoreRows]] = {}  # of the clips, which the claim's comparisons need
    for comparison in claim.comparisons if finished else ():
        for side, score in ((comparison.better, comparison.score), (comparison.than, comparison.than_score)):
            if side == name:
                wanted = score or comparison.metric
                scored = _scored(finished, comparison.measurement, wanted, comparison.metric, read)
                scores.setdefault(comparison.measurement, {})[wanted] = scored
    arm = ArmScores(
        name=name,
        planned=len(cells),
        seeds=tuple(result.run.config.train.seed for result in finished),
        trainings=tuple(result.name for result in finished),
        clips=tuple(key_of_test_clips(result.run) for result in finished),
        numbers={metric: values for metric, values in numbers.items() if any(value is not None for value in values)},
        scores=scores,
        absent=plan.absent.get((claim.name, name), ""),
        results=results,
    )
    if not finished:
        return arm
    config = cells[0].config
    seconds = [sum(result.run.seconds(stage) for stage in ("tokenizer", "world_model")) for result in finished]
    model, autoencoder = budget.parameters(config)
    trained = model + autoencoder * (config.tokenizer_train.steps > 0)
    frozen = model + autoencoder - trained
    return replace(
        arm,
        parameters=f"{trained / 1e6:.2f} M" + (f", {frozen / 1e6:.2f} M frozen" if frozen else ""),
        steps=None if config.train.curriculum else config.train.steps,
        tflop=round(sum(budget.training_cost(config, "flops")) / 1e12, 1),
        minutes=round(sum(seconds) / len(seconds) / 60, 1),
    )


def key_of_test_clips(run: Run) -> str:
    """Returns a key of a run's test clips, which are the expert's and the same whatever recipe the others follow."""
    config = run.config
    return replace(run, config=replace(config, sim=replace(config.sim, recipe=SimConfig().recipe))).keys()["collect"]


def merge_arms(one: ArmScores, other: ArmScores) -> ArmScores:
    """Returns the scores of the trainings of both, by seed; of two with the same seed, that of ``other``."""
    sides = {seed: (arm, row) for arm in (one, other) for row, seed in enumerate(arm.seeds)}
    ordered = [sides[seed] for seed in sorted(sides)]
    names = dict.fromkeys([*one.numbers, *other.numbers])
    numbers = {
        name: [arm.numbers[name][row] if name in arm.numbers else None for arm, row in ordered] for name in names
    }
    scores: dict[str, dict[str, ScoreRows]] = {}
    for source in dict.fromkeys([*one.scores, *other.scores]):
        by_name = [arm.scores.get(source, {}) for arm in (one, other) if arm.seeds]
        scores[source] = {}
        for name in dict.fromkeys(name for each in by_name for name in each):
            reason = next((each[name].reason for each in by_name if name in each and each[name].reason), "")
            if not reason and all(name in each for each in by_name):
                rows = tuple(arm.scores[source][name].rows[row] for arm, row in ordered)
                scores[source][name] = ScoreRows(rows)
            else:
                scores[source][name] = ScoreRows(reason=reason or f"some seeds have no score named {name}")
    minutes = [arm.minutes for arm, _ in ordered if arm.minutes is not None]
    return replace(
        other if other.seeds else one,
        planned=max(one.planned, other.planned, len(ordered)),
        seeds=tuple(sorted(sides)),
        trainings=tuple(arm.trainings[row] for arm, row in ordered),
        clips=tuple(arm.clips[row] for arm, row in ordered),
        numbers=numbers,
        scores=scores,
        minutes=round(sum(minutes) / len(minutes), 1) if minutes else None,
    )


def _scored(finished: Sequence[RunResult], source: str, score: str, metric: str, read: ReadScores) -> ScoreRows:
    """Returns the clips' scores by one name, if all finished seeds have them."""
    rows = []
    for result in finished:
        scores, reason = read(result.run, source)
        if score not in scores:
            return ScoreRows(reason=reason or result.reasons.get(metric) or f"no score named {score}")
        values = np.asarray(scores[score], float)
        rows.append(tuple(rounded(float(value), CLIP_DIGITS) or 0.0 for value in values))
    return ScoreRows(tuple(rows))


def rounded(value: float | None, digits: int) -> float | None:
    """Returns a number with this many significant digits; NaN stays NaN and None stays None."""
    return value if value is None or math.isnan(value) else float(f"{value:.{digits}g}")
