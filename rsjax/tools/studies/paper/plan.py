"""Plans the cells that the claims need, in the order in which they run, as far as a budget allows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from rsjax.config import ComponentConfig, Config, ConfigError, CurriculumStageConfig, metaworld, presets, require
from rsjax.config.config_fields import config_fields, with_values
from rsjax.config.sim import EXPERT
from rsjax.tools.pipeline.run import Run
from rsjax.tools.sim.episode import ENVIRONMENTS
from rsjax.tools.studies.ablation.grid import OTHER_SEEDS, SEED, Value, cell_name
from rsjax.tools.studies.paper import budget
from rsjax.tools.studies.paper.budget import Scale
from rsjax.tools.studies.paper.claim import Arm, Claim
from rsjax.tools.studies.paper.measurements import seconds_of

SLACK = 1.05  # share of the budget that the estimates may take
Vary = Literal["model", "everything"]  # a seed decides the model's training; or the clips and the tokenizer as well
VERDICT_SEEDS = 2  # seeds of each arm that a verdict needs
KEPT = ("prompt_frames", "sim", "data", "eval")  # parts of the base preset's configuration that all arms have


@dataclass(frozen=True)
class Cell:
    """A training and its evaluation.

    Attributes:
        name: the name of its directory; it ends with a content key, which keeps the cells of several budgets apart.
        config: what is trained.
        uses: each (claim, arm) for which it runs.
    """

    name: str
    config: Config
    uses: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Task:
    """A step of a plan: a cell's training with its evaluation, or a measurement of a trained cell.

    Attributes:
        cell: the cell's name.
        measurement: the measurement's name; empty: the training.
        claim: the first claim that needs the task.
        seconds: the estimate; it includes a shared stage's seconds if the task is the first that needs this stage.
    """

    cell: str
    measurement: str
    claim: str
    seconds: float


@dataclass(frozen=True)
class Plan:
    """The cells and tasks that some claims need at a scale.

    Attributes:
        cells: by name, including those that the budget leaves out.
        tasks: in the order in which they run.
        left_out: tasks that the budget has no time for; they are known before anything runs.
        absent: (claim, arm) → why the arm cannot be trained.
    """

    scale: Scale
    claims: tuple[Claim, ...]
    cells: Mapping[str, Cell]
    tasks: tuple[Task, ...]
    left_out: tuple[Task, ...]
    absent: Mapping[tuple[str, str], str]

    def of(self, claim: str, arm: str) -> tuple[Cell, ...]:
        """Returns an arm's cells, one for each seed."""
        return tuple(cell for cell in self.cells.values() if (claim, arm) in cell.uses)


def make_plan(
    claims: Sequence[Claim], scale: Scale, data: Path, seeds: Sequence[int] = range(budget.SEEDS), vary: Vary = "model"
) -> Plan:
    """Returns the cells of claims, which share the budget, and the tasks in their order.

    The sizes of the cells depend only on the budget, not on the claims. Claims of rank 0 come first, with all seeds,
    then the others with ``VERDICT_SEEDS``, then further seeds.

    Args:
        data: the directory of simulated data sets.
        seeds: of the trainings of each arm.
        vary: what differs between the trainings of an arm.
    """
    absent: dict[tuple[str, str], str] = {}
    cells: dict[str, Cell] = {}  # by content key
    tasks: dict[tuple[str, str], Task] = {}
    made = set[str]()
    first = [claim for claim in claims if not claim.rank]
    others = [claim for claim in claims if claim.rank]
    few = seeds[:VERDICT_SEEDS]
    more = seeds[VERDICT_SEEDS:]
    ordered = [
        *((claim, arm, seed) for claim in first for seed in seeds for arm in claim.arms),
        *((claim, arm, seed) for claim in others for seed in few for arm in claim.arms),
        *((claim, arm, seed) for seed in more for claim in others for arm in claim.arms),
    ]
    for claim, arm, seed in ordered:
        try:
            config = arm_config(arm, scale, seed, vary)
        except ConfigError as error:
            absent[claim.name, arm.name] = str(error)
            continue
        keys = Run(config, Path(), data).keys()
        key = keys["evaluation"]
        use = (claim.name, arm.name)
        if key not in cells:
            cells[key] = Cell(f"{cell_name(_label(arm), seed)}-{key[:8]}", config, ())
            seconds = _new_seconds(config, keys, made) + budget.evaluation_seconds(config)
            tasks[key, ""] = Task(cells[key].name, "", claim.name, seconds)
        cells[key] = replace(cells[key], uses=(*cells[key].uses, use))
        for name in claim.measurements(arm.name):
            task = Task(cells[key].name, name, claim.name, seconds_of(name, config))
            tasks.setdefault((key, name), task)
    fits = list[Task]()
    left_out = list[Task]()
    spent = 0.0
    for number, task in enumerate(tasks.values()):
        spent += task.seconds
        (fits if spent <= SLACK * scale.seconds or not number else left_out).append(task)
    named = {cell.name: cell for cell in cells.values()}
    return Plan(scale, tuple(claims), named, tuple(fits), tuple(left_out), absent)


def _new_seconds(config: Config, keys: Mapping[str, str], made: set[str]) -> float:
    """Returns the seconds of the stages that no earlier cell makes, and adds their keys to ``made``."""
    parts = {
        "collect": budget.collect_seconds,
        "tokenizer": budget.tokenizer_seconds,
        "world_model": budget.model_seconds,
        "depth_estimator": budget.depth_estimator_seconds,
        "annotations": budget.annotation_seconds,
    }
    # Copies with estimated annotations are not a stage; all world models on them share them.
    copies = [part.annotations for stage in config.train.curriculum for part in stage.components]
    keys = {**keys, "annotations": " ".join([keys["tokens"], *copies])}
    new = [stage for stage in parts if stage in keys and keys[stage] not in made]
    made.update(keys[stage] for stage in new)
    return sum(parts[stage](config) for stage in new)


def _label(arm: Arm) -> dict[str, Value]:
    """Returns the values that an arm varies, for the name of its directory."""
    family = {"model": arm.model or arm.preset} if arm.model or arm.preset else {}
    stages = {}
    if arm.curriculum:
        order = "+".join(f"{name} {epochs:g}" for name, epochs in arm.curriculum.items())
        stages["curriculum"] = order + " mixed" * arm.mixed
    shares = {name: f"{share:.2g}" for name, share in (("data", arm.data), ("rate", arm.rate)) if share != 1}
    estimates = {"annotations": arm.annotations} if arm.annotations != "own" else {}
    return {**family, **arm.values, **stages, **shares, **estimates}


def arm_config(arm: Arm, scale: Scale, seed: int, vary: Vary = "model") -> Config:
    """Returns the configuration of an arm with a seed.

    Seed 0 of everything is seed 0 of the model alone: clips and tokenizer are the preset's.

    Raises:
        ConfigError: there is no such preset, or the base preset lacks a field of the arm's.
    """
    base = scale.base
    config = base
    if arm.preset:
        name = f"{arm.preset}_tiny"
        if name not in presets.PRESETS:
            raise ConfigError(f"there is no preset {name} in this version")
        config = replace(presets.get(name), **{field: getattr(base, field) for field in KEPT})
        config = replace(config, model=config.model.for_tasks(base.sim.train_tasks))
    elif arm.model:
        config = base.with_family(arm.model)
    try:
        config = with_values(config, {**arm.values, SEED: seed})
        if vary == "everything":
            config = with_values(config, {name: config_fields(config)[name].value + seed for name in OTHER_SEEDS})
    except (AttributeError, TypeError) as error:
        raise ConfigError(f"the preset {config.name} has no such field ({error})") from error
    if arm.equal != "steps":
        tokenizer, model = budget.training_cost(config, arm.equal)
        whole = sum(budget.training_cost(base, arm.equal))
        if arm.preset:  # the autoencoder is its own, so that its training is scaled too
            config = budget.cut(config, whole / (tokenizer + model))
        else:
            require(whole > tokenizer, "its tokenizer alone takes as long as tokenizer and model of the base preset")
            steps = round(config.train.steps * (whole - tokenizer) / model) if model else config.train.steps
            config = budget.with_steps(config, steps)
    if arm.rate != 1:
        rate = float(f"{arm.rate * config.train.optimizer.learning_rate:.2g}")
        config = with_values(config, {"train.optimizer.learning_rate": rate})
    stages = _stages(arm, config)
    return with_values(config, {"train.curriculum": stages}) if stages else config


def _stages(arm: Arm, config: Config) -> tuple[CurriculumStageConfig, ...]:
    """Returns the stages of an arm's training, for about as many steps as the configuration has."""
    clips = config.sim.episodes - config.sim.test_episodes
    drawn = config.train.steps * config.train.batch_size
    if arm.annotations != "own":
        return (CurriculumStageConfig((ComponentConfig(annotations=arm.annotations),), drawn / clips),)
    if arm.data < 1:
        some = max(1, round(arm.data * clips))
        return (CurriculumStageConfig((ComponentConfig(clips=some),), drawn / some),)
    if not arm.curriculum:
        return ()
    sim = config.sim
    if sim.env == "metaworld":  # the tasks take turns
        simple = sum(task in metaworld.SIMPLE for task in sim.train_tasks) / len(sim.train_tasks)
    else:
        environment = ENVIRONMENTS[sim.env]
        simple = sim.shares.get(EXPERT, 0.0) * sum(environment.modes[mode] for mode in environment.simple)
    expected = {"simple": simple * clips, "difficult": (1 - simple) * clips}
    read = {name: epochs * expected[name] for name, epochs in arm.curriculum.items()}
    factor = drawn / sum(read.values())
    if arm.mixed:
        parts = tuple(ComponentConfig(difficulties=(name,), weight=number) for name, number in read.items())
        return (CurriculumStageConfig(parts, drawn / clips),)
    return tuple(
        CurriculumStageConfig((ComponentConfig(difficulties=(name,)),), epochs * factor)
        for name, epochs in arm.curriculum.items()
    )
