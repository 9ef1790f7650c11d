"""The cells that the claims need, in the order in which they run, as far as a budget goes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rsjax.ablation.grid import SEED, Value, cell_name
from rsjax.config import Config, ConfigError, CurriculumStageConfig, presets
from rsjax.config.curriculum import parse_stage
from rsjax.config.leaves import with_values
from rsjax.paper import budget
from rsjax.paper.budget import Scale
from rsjax.paper.claim import Arm, Claim
from rsjax.pipeline.run import Run
from rsjax.sim.expert import MODES, SIMPLE

SLACK = 1.05  # of the budget that the estimates may take


@dataclass(frozen=True)
class Cell:
    """A training and its evaluation.

    Attributes:
        name: its directory; it ends with a content key, so that a directory keeps the cells of several budgets apart.
        config: what is trained.
        seconds: the estimate, with those of shared stages that it is the first to need.
        uses: (claim, arm) for which it runs.
    """

    name: str
    config: Config
    seconds: float
    uses: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Plan:
    """All cells of some claims at a scale.

    Attributes:
        cells: in the order in which they run.
        left_out: those that the budget has no time for, known before anything runs.
        absent: (claim, arm) → why the arm cannot be trained.
    """

    scale: Scale
    claims: tuple[Claim, ...]
    cells: tuple[Cell, ...]
    left_out: tuple[Cell, ...]
    absent: Mapping[tuple[str, str], str]

    def of(self, claim: str, arm: str) -> tuple[Cell, ...]:
        """Returns an arm's cells, one for each seed; those left out too."""
        return tuple(cell for cell in (*self.cells, *self.left_out) if (claim, arm) in cell.uses)


def make_plan(known: Sequence[Claim], wanted: Sequence[Claim], scale: Scale, data: Path) -> Plan:
    """Returns the cells of the wanted claims.

    Args:
        known: all claims, which share the budget: the cells do not depend on which of them are wanted.
        wanted: some of these.
        data: the directory of simulated data sets.
    """
    absent: dict[tuple[str, str], str] = {}
    cells, names = list[Cell](), {claim.name for claim in wanted}
    made: dict[str, int] = {}  # content key → place
    shared = set[str]()
    for claim, arm, seed in _ordered(known):
        try:
            config = arm_config(arm, scale, seed)
        except ConfigError as error:
            absent[claim.name, arm.name] = str(error)
            continue
        keys, use = Run(config, Path(), data).keys(), (claim.name, arm.name)
        if keys["evaluation"] in made:
            place = made[keys["evaluation"]]
            cells[place] = replace(cells[place], uses=(*cells[place].uses, use))
            continue
        made[keys["evaluation"]] = len(cells)
        seconds = budget.cell_seconds(config, scale.base)
        for stage, part in (("collect", budget.collect_seconds), ("tokenizer", budget.tokenizer_seconds)):
            if stage in keys and keys[stage] not in shared:
                shared.add(keys[stage])
                seconds += part(config)
        name = f"{cell_name(_label(arm), seed)}-{keys['evaluation'][:8]}"
        cells.append(Cell(name, config, seconds, (use,)))
    fits, left_out, spent = list[Cell](), list[Cell](), 0.0
    for cell in cells:
        spent += cell.seconds
        (fits if spent <= SLACK * scale.seconds or not fits else left_out).append(cell)
    mine = lambda cell: any(claim in names for claim, _ in cell.uses)  # noqa: E731
    return Plan(scale, tuple(wanted), tuple(filter(mine, fits)), tuple(filter(mine, left_out)), absent)


def _ordered(known: Sequence[Claim]) -> list[tuple[Claim, Arm, int]]:
    """Claims of rank 0 with all seeds; then the first seed of all others, then the second …"""
    seeds, first = range(budget.SEEDS), [claim for claim in known if not claim.rank]
    others = [claim for claim in known if claim.rank]
    return [
        *((claim, arm, seed) for claim in first for seed in seeds for arm in claim.arms),
        *((claim, arm, seed) for seed in seeds for claim in others for arm in claim.arms),
    ]


def _label(arm: Arm) -> dict[str, Value]:
    """Returns what an arm varies, for the name of its directory."""
    family = {"model": arm.model or arm.preset} if arm.model or arm.preset else {}
    stages = {"curriculum": "+".join(arm.curriculum) + " mixed" * arm.mixed} if arm.curriculum else {}
    return {**family, **arm.values, **stages, **({"data": f"{arm.data:.2g}"} if arm.data < 1 else {})}


def arm_config(arm: Arm, scale: Scale, seed: int) -> Config:
    """Returns the configuration of an arm with a seed.

    Raises:
        ConfigError: there is no such preset, or the base preset lacks a field of the arm's.
    """
    base, config = scale.base, scale.base
    if arm.preset:
        name = f"{arm.preset}_{base.name}"
        if name not in presets.PRESETS:
            raise ConfigError(f"there is no preset {name} in this version")
        whole = budget.cut(presets.get(name), scale.share)
        kept = {field: getattr(base, field) for field in ("prompt_frames", "sim", "data", "eval")}
        config = replace(whole, **kept)
    elif arm.model:
        config = base.with_family(arm.model)
    try:
        config = with_values(config, {**arm.values, SEED: seed})
    except (AttributeError, TypeError) as error:
        raise ConfigError(f"the preset {config.name} has no such field ({error})") from error
    per_step = budget.step_seconds(config)
    if arm.equal == "seconds" and per_step and not arm.preset:
        steps = round(base.train.steps * budget.step_seconds(base) / per_step)
        config = with_values(config, {"train.steps": steps})
    stages = _stages(arm, config)
    return with_values(config, {"train.curriculum": stages}) if stages else config


def _stages(arm: Arm, config: Config) -> tuple[CurriculumStageConfig, ...]:
    """Returns the stages of an arm's training, for about as many steps as the configuration has."""
    clips, drawn = config.sim.episodes - config.sim.test_episodes, config.train.steps * config.train.batch_size
    if arm.data < 1:
        some = max(1, round(arm.data * clips))
        return (parse_stage(f"all#{some}:{drawn / some!r}"),)
    if not arm.curriculum:
        return ()
    simple = sum(MODES[mode] for mode in SIMPLE)
    expected = {"simple": simple * clips, "difficult": (1 - simple) * clips}
    epochs = {name: float(number) for name, _, number in (word.partition(":") for word in arm.curriculum)}
    read = {name: number * expected[name] for name, number in epochs.items()}
    factor = drawn / sum(read.values())
    if arm.mixed:
        parts = "+".join(f"{name}={number!r}" for name, number in read.items())
        return (parse_stage(f"{parts}:{drawn / clips!r}"),)
    return tuple(parse_stage(f"{name}:{number * factor!r}") for name, number in epochs.items())
