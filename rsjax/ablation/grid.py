"""What a grid consists of: axes, and a cell for every combination of their values with every seed."""

import hashlib
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from rsjax.ablation.fields import GridError, Value, leaves, parse_value, with_values
from rsjax.config import Config, ConfigError
from rsjax.errors import did_you_mean

DEFAULT_AXES = ("model.depth=True,False", "loss.keypoints=True,False")
SEED = "train.seed"
TASK = "SLURM_ARRAY_TASK_ID"
NAME_LENGTH = 180  # of a cell's directory; file systems allow 255, and files in the making add endings

# A weight or constant of a term that a switch takes away: where it is off, all its values give the same cell.
_SWITCHES = {"loss.depth": "model.depth"} | dict.fromkeys(
    ("loss.keypoint", "loss.attention", "loss.gamma", "loss.num_keypoints"), "loss.keypoints"
)


@dataclass(frozen=True)
class Axis:
    """A field that the grid varies, and its values in order."""

    field: str
    values: tuple[Value, ...]


@dataclass(frozen=True)
class Cell:
    """One run of a grid.

    Attributes:
        name: its directory within the grid's, unique there.
        values: of every field that the grid varies, by dotted name.
        seed: ``train.seed``.
        config: what it runs.
    """

    name: str
    values: Mapping[str, Value]
    seed: int
    config: Config


def parse_axes(base: Config, texts: Sequence[str]) -> tuple[Axis, ...]:
    """Axes from ``FIELD=VALUE,VALUE…`` each; dashes in a field's name count as underscores.

    Raises:
        GridError: a field that does not exist, stands twice or is the seed; a value that is not of its type or stands
            twice.
    """
    known, axes = leaves(base), {}
    for text in texts:
        name, equals, values = text.partition("=")
        field = name.strip().lstrip("-").replace("-", "_")
        if not equals or not values:
            raise GridError(f"--grid {text}: write FIELD=VALUE,VALUE, such as {DEFAULT_AXES[0]}")
        if field not in known:
            raise GridError(f"--grid {text}: no field {field!r}{did_you_mean(field, known)}")
        if field == SEED:
            raise GridError(f"--grid {text}: seeds have an option of their own, --seeds {values.replace(',', ' ')}")
        if field == "name":
            raise GridError(f"--grid {text}: the preset's name changes nothing; vary another field")
        if field in axes:
            raise GridError(f"--grid {text}: {field} has an axis already; put all its values into one")
        parsed = tuple(parse_value(field, known[field].kind, value.strip()) for value in values.split(","))
        if len(set(parsed)) < len(parsed):
            raise GridError(f"--grid {text}: a value stands twice")
        axes[field] = Axis(field, parsed)
    return tuple(axes.values())


def expand(base: Config, axes: Sequence[Axis], seeds: Sequence[int]) -> tuple[Cell, ...]:
    """All cells. The last axis changes fastest and the seed slowest, so that a grid that stops early has whole tables.

    Raises:
        GridError: no seeds, a seed that stands twice or is not in [0, 2³²), or cells that cannot run, by name.
    """
    if not seeds or len(set(seeds)) < len(seeds):
        raise GridError(f"--seeds {' '.join(map(str, seeds))}: give one or more, each once")
    for seed in seeds:
        if not 0 <= seed < 2**32:
            raise GridError(f"--seeds: {seed} is not between 0 and 2^32 - 1")
    cells, wrong = [], []
    fields = [axis.field for axis in axes]
    for seed in seeds:
        for combination in itertools.product(*(axis.values for axis in axes)):
            values = dict(zip(fields, combination, strict=True))
            try:
                cells.append(make_cell(base, values, seed))
            except ConfigError as error:
                wrong.append(f"{cell_name(values, seed)}: {error}")
    if wrong:
        raise GridError(f"{len(wrong)} of {len(wrong) + len(cells)} cells cannot run; the first is {wrong[0]}")
    return tuple(cells)


def make_cell(base: Config, values: Mapping[str, Value], seed: int, name: str = "") -> Cell:
    """The cell with these values.

    Args:
        name: of a cell that has one already.

    Raises:
        ConfigError: the combination cannot run.
    """
    return Cell(name or cell_name(values, seed), values, seed, with_values(base, {**values, SEED: seed}))


def cell_name(values: Mapping[str, Value], seed: int) -> str:
    """A directory's name that reads as the values do: ``model.depth=True,loss.gamma=5.0,seed=0``.

    Where that is too long, or a text has characters that do not belong into a file's name, they are left out and a
    digest of the values keeps the name unique.
    """
    name = ",".join([*(f"{field}={value}" for field, value in values.items()), f"seed={seed}"])
    safe = re.sub(r"[^A-Za-z0-9_.=,+-]", "-", name)
    if safe == name and len(name) <= NAME_LENGTH:
        return name
    return f"{safe[: NAME_LENGTH - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def idle(cells: Sequence[Cell]) -> list[str]:
    """Fields that are varied where their switch is off, one line each: those cells repeat each other."""
    lines = []
    for field, switch in _SWITCHES.items():
        off = {cell.values[field] for cell in cells if field in cell.values and not leaves(cell.config)[switch].value}
        if len(off) > 1:
            lines.append(f"{field} changes nothing where {switch} is False; cells that differ in it alone are the same")
    return lines


@dataclass(frozen=True)
class Choice:
    """Which cells of a grid a command is about.

    Attributes:
        number: one cell, counted from 0; None for all.
        only: names or shell patterns (``model.depth=True,*``); of the cells those that match any. Empty for all.
        skip: likewise, those that are left out.
    """

    number: int | None = None
    only: Sequence[str] = ()
    skip: Sequence[str] = ()

    def of(self, cells: Sequence[Cell]) -> tuple[Cell, ...]:
        """The chosen cells, in order.

        Raises:
            GridError: there is no such number, or a name or pattern that fits no cell.
        """
        for flag, patterns in (("--only", self.only), ("--skip", self.skip)):
            for pattern in patterns:
                if not _matches(cells, [pattern]):
                    near = did_you_mean(pattern, [cell.name for cell in cells])
                    raise GridError(f"{flag} {pattern}: no such cell{near} (--list names them)")
        if self.number is not None and not 0 <= self.number < len(cells):
            raise GridError(
                f"cell {self.number} is not in this grid, whose cells are 0 … {len(cells) - 1} (--list names them)"
            )
        kept = _matches(cells, self.only) if self.only else {cell.name for cell in cells}
        kept -= _matches(cells, self.skip)
        numbered = enumerate(cells)
        return tuple(cell for i, cell in numbered if cell.name in kept and self.number in (None, i))


def task_number(environment: Mapping[str, str]) -> int | None:
    """Which cell a task of a Slurm array job is to run; None outside of array jobs.

    Raises:
        GridError: the variable is not a number.
    """
    text = environment.get(TASK)
    if not text:
        return None
    if not text.isdigit():
        raise GridError(f"{TASK} is {text!r}, not a cell's number; unset it, or choose with --cell")
    return int(text)


def _matches(cells: Sequence[Cell], patterns: Sequence[str]) -> set[str]:
    return {cell.name for cell in cells if any(fnmatchcase(cell.name, pattern) for pattern in patterns)}
