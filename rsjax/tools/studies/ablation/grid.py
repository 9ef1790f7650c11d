"""Makes the cells of a grid, one per combination of values and seed, and ``grid.json``, which lists them."""

import dataclasses
import fnmatch
import hashlib
import itertools
import math
import re
import typing
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from rsjax.config import Config, ConfigError, from_dict, require, to_dict
from rsjax.config.config_fields import ConfigField, config_fields, with_values
from rsjax.errors import UserError, did_you_mean
from rsjax.files import lock, read_json, write_json
from rsjax.progress import note

Value = bool | int | float | str

PHYSICS = ("model.depth=none,branch,head", "model.loss.keypoints=none,printed,difference,motion")
ATTENTION = "model.loss.attention_weight"
WEIGHTS = (  # λ₁, λ₂, λ₃, γ, K and N₀ in equal ratios around the usual values
    "model.loss.depth_weight=0.1,0.3,1,3,10",
    "model.loss.keypoint_weight=0.001,0.003,0.01,0.03,0.1",
    "model.loss.attention_weight=0.1,0.3,1,3,10",
    "model.loss.gamma=1.25,2.5,5,10,20",
    "model.loss.num_keypoints=8,16,32,64,128",
    "sim.tracks=64,128,256,512,1024",
)
NAMES = ("physics", "weights")  # named grids
SWITCHES = {  # a field → the switch that is "none" where the field has no effect
    "model.loss.depth_weight": "model.depth",
    "model.loss.keypoint_weight": "model.loss.keypoints",
    "model.loss.attention_weight": "model.loss.keypoints",
    "model.loss.gamma": "model.loss.keypoints",
    "model.loss.attention": "model.loss.keypoints",
    "model.loss.num_keypoints": "model.loss.keypoints",
}
SEED = "train.seed"
MOST_SEEDS = 1000
OTHER_SEEDS = ("tokenizer_train.seed", "sim.seed")  # what a seed of everything decides too: the tokenizer, the clips
FILE = "grid.json"
LIBRARIES = ("rsjax", "jax", "flax", "optax", "numpy")  # libraries whose versions the file records
NAME_LENGTH = 180  # limit for a cell's directory: file systems allow 255, and temporary files add suffixes
NUMBERS = {int: "a whole number", float: "a number"}


@dataclasses.dataclass(frozen=True)
class Grid:
    """Cells and the fields that vary among them.

    Attributes:
        fields: the dotted names of the fields that vary; the configurations agree in all other fields except the seed.
        cells: configuration by name, in order. A cell's name is its directory within the grid's.
        versions: library → version, for the command that made the grid.
    """

    fields: tuple[str, ...]
    cells: Mapping[str, Config]
    versions: Mapping[str, str] = dataclasses.field(default_factory=lambda: {each: version(each) for each in LIBRARIES})


@dataclasses.dataclass(frozen=True)
class Choice:
    """Some of a grid's cells.

    Attributes:
        number: the position of a single cell, counted from 0; None for all.
        only: names or shell patterns (``model.depth=head,*``); cells that match none are left out. Empty for all.
        skip: names or patterns of cells to leave out.
    """

    number: int | None = None
    only: Sequence[str] = ()
    skip: Sequence[str] = ()

    def of(self, names: Sequence[str]) -> tuple[str, ...]:
        """Returns the chosen names, in order.

        Raises:
            ConfigError: no cell has this number, or none matches one of the patterns.
        """
        for flag, patterns in (("--only", self.only), ("--skip", self.skip)):
            for pattern in patterns:
                problem = f"{flag} {pattern}: no such cell{did_you_mean(pattern, names)} (--list names them)"
                require(_matches(names, [pattern]) != set(), problem)
        require(
            self.number is None or 0 <= self.number < len(names),
            f"cell {self.number} is not in this grid; its cells are 0 … {len(names) - 1} (--list names them)",
        )
        kept = (_matches(names, self.only) if self.only else set(names)) - _matches(names, self.skip)
        return tuple(name for i, name in enumerate(names) if name in kept and self.number in (None, i))


def _matches(names: Sequence[str], patterns: Sequence[str]) -> set[str]:
    return {name for name in names if any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)}


def parse_axes(base: Config, texts: Sequence[str]) -> dict[str, tuple[Value, ...]]:
    """Parses ``FIELD=VALUE,VALUE…`` arguments into values by field. Dashes in a field's name count as underscores.

    Raises:
        ConfigError: a field does not exist, is repeated or is the seed; a value has another type or is repeated.
    """
    known = config_fields(base)
    axes = dict[str, tuple[Value, ...]]()
    for text in texts:
        name, _, values = text.partition("=")
        field = name.strip().lstrip("-").replace("-", "_")
        for wrong, cure in (
            (not values, f"write FIELD=VALUE,VALUE, such as {PHYSICS[0]}, or {' or '.join(NAMES)} alone"),
            (field not in known, f"no field {field!r}{did_you_mean(field, known)}"),
            (field == SEED, f"seeds have their own option, --seeds {values.replace(',', ' ')}"),
            (field == "name", "the preset's name has no effect; vary another field"),
            (field in axes, f"{field} has an axis already; put all its values into one"),
        ):
            require(not wrong, f"--grid {text}: {cure}")
        axes[field] = tuple(parse_value(field, known[field].kind, value.strip()) for value in values.split(","))
        require(len(set(axes[field])) == len(axes[field]), f"--grid {text}: a value is repeated; name each once")
    return axes


def parse_value(name: str, kind: Any, text: str) -> Value:
    """Parses one value of a field.

    Args:
        name: the field's name, for the error.
        kind: its declared type.

    Raises:
        ConfigError: the text is not of this type, or the field takes more than one value.
    """
    options: tuple[Any, ...] = ()
    if kind is bool:
        options = (True, False)
    elif typing.get_origin(kind) is Literal:
        options = typing.get_args(kind)
    if options:
        choices = {str(option): option for option in options}
        problem = f"{name} is {text!r} in the grid{did_you_mean(text, choices)} (choices: {', '.join(choices)})"
        require(text in choices, problem)
        return choices[text]
    if kind is str:
        return text
    require(kind in NUMBERS, f"{name} takes several values, so a grid cannot vary it; set it for all cells (--{name})")
    with suppress(ValueError, OverflowError):
        if math.isfinite(value := kind(text)):
            return value
    raise ConfigError(f"{name} is {text!r} in the grid; it takes {NUMBERS[kind]}")


def chosen_grid(base: Config, texts: Sequence[str], seeds: Sequence[int]) -> Grid:
    """Returns the grid that ``--grid`` names: all combinations of ``FIELD=VALUE,VALUE…`` arguments, or a named grid.

    Raises:
        ConfigError: as for :func:`parse_axes` and :func:`expand`.
    """
    if tuple(texts) == ("physics",):
        return physics_grid(base, seeds)
    if tuple(texts) == ("weights",):
        return expand_each(base, parse_axes(base, WEIGHTS), seeds)
    return expand(base, parse_axes(base, texts), seeds)


def physics_grid(base: Config, seeds: Sequence[int]) -> Grid:
    """Returns the cells of all ways to use depth and keypoint terms.

    Eq. 7 is a part of the printed terms alone: its cost would hide what the others do.

    Raises:
        ConfigError: as for :func:`make_grid`.
    """
    axes = parse_axes(base, PHYSICS)
    usual = values_of(base, (ATTENTION,))[ATTENTION]
    combinations = []
    for values in itertools.product(*axes.values()):
        combination = dict(zip(axes, values, strict=True))
        has_eq_7 = combination["model.loss.keypoints"] in ("none", "printed")  # with none it has no effect
        combinations.append(combination | {ATTENTION: usual if has_eq_7 else 0.0})
    return make_grid(base, (*axes, ATTENTION), combinations, seeds)


def expand(base: Config, axes: Mapping[str, Sequence[Value]], seeds: Sequence[int]) -> Grid:
    """Returns the cells of all combinations. The last axis changes fastest.

    Raises:
        ConfigError: as for :func:`make_grid`.
    """
    combinations = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
    return make_grid(base, tuple(axes), combinations, seeds)


def expand_each(base: Config, axes: Mapping[str, Sequence[Value]], seeds: Sequence[int]) -> Grid:
    """Returns the base's cell, and those in which one field has another of its values and the others the base's.

    Raises:
        ConfigError: as for :func:`make_grid`.
    """
    usual = values_of(base, tuple(axes))
    others = [usual | {field: value} for field, values in axes.items() for value in values if value != usual[field]]
    return make_grid(base, tuple(axes), [usual, *others], seeds)


def make_grid(
    base: Config, fields: tuple[str, ...], combinations: Sequence[Mapping[str, Value]], seeds: Sequence[int]
) -> Grid:
    """Returns the cells of these combinations. The seed changes slowest, so a stopped grid has complete tables.

    Raises:
        ConfigError: there is no seed or too many, or one is repeated or outside [0, 2³²); or some cells cannot run, and
            the message names the first of them.
    """
    require(len(seeds) <= MOST_SEEDS, f"--seeds: {len(seeds):,} of them; name {MOST_SEEDS:,} at most")
    flag = f"--seeds {' '.join(map(str, seeds))}"
    require(0 < len(seeds) == len(set(seeds)), f"{flag}: name one or more, each once")
    require(all(0 <= seed < 2**32 for seed in seeds), f"{flag}: a seed lies between 0 and 2^32 - 1")
    cells = dict[str, Config]()
    wrong = list[str]()
    for seed, values in itertools.product(seeds, combinations):
        try:
            cells[cell_name(values, seed)] = with_values(base, {**values, SEED: seed})
        except (ConfigError, AttributeError, TypeError) as error:  # a section that is chosen may lack a field
            wrong.append(f"{cell_name(values, seed)}: {error}")
    require(not wrong, f"{len(wrong)} of {len(wrong) + len(cells)} cells cannot run; the first is {''.join(wrong[:1])}")
    return Grid(fields, cells)


def values_of(config: Config, fields: Sequence[str]) -> dict[str, Value]:
    """Returns the values of these fields, by dotted name; "–" for one that the configuration's section lacks."""
    known = config_fields(config)
    return {field: known[field].value if field in known else "–" for field in fields}


def cell_name(values: Mapping[str, Value], seed: int) -> str:
    """Returns a directory name that shows the values, such as ``model.depth=head,model.loss.gamma=5.0,seed=0``.

    A name that is too long is shortened, unsafe characters are replaced, and a hash then keeps the name unique.
    """
    name = ",".join([*(f"{field}={value}" for field, value in values.items()), f"seed={seed}"])
    safe = re.sub(r"[^A-Za-z0-9_.=,+-]", "-", name)
    if safe == name and len(name) <= NAME_LENGTH:
        return name
    return f"{safe[: NAME_LENGTH - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def repeated_cells(grid: Grid) -> list[str]:
    """Returns one line per field that varies among cells in which its switch is off, so that it has no effect."""
    cells = [config_fields(config) for config in grid.cells.values()]
    lines = []
    for field, switch in SWITCHES.items():
        if field not in grid.fields:
            continue
        off = {known[field].value for known in cells if switch in known and known[switch].value == "none"}
        if len(off) > 1:
            lines.append(f"{field} has no effect where {switch} is none; cells that differ in it alone are the same")
    return lines


UNSET = ConfigField("not set", None)


def merge(before: Grid | None, new: Grid, out: Path) -> tuple[Grid, tuple[str, ...]]:
    """Adds cells to a directory's grid.

    A cell with the same values as an earlier cell is that cell, and keeps its earlier name. The others are named by all
    fields that vary now.

    Args:
        out: the directory, for the error.

    Returns:
        The whole grid, and the names of the new cells in it.

    Raises:
        ConfigError: the earlier cells differ in other fields, which the message names.
    """
    if before is None:
        return new, tuple(new.cells)
    fields = tuple(dict.fromkeys((*before.fields, *new.fields)))
    earlier = {tuple(values_of(config, fields).values()): config for config in before.cells.values()}
    usual = next(iter(before.cells.values()))
    differing: dict[str, None] = {}
    for config in new.cells.values():
        like = earlier.get(tuple(values_of(config, fields).values()))
        ours = config_fields(config)
        theirs = config_fields(like or usual)
        # Other choices of a section have other fields.
        skipped = () if like else tuple(f"{field}." for field in fields)
        for name in theirs | ours:
            there = theirs.get(name, UNSET)
            here = ours.get(name, UNSET)
            compared = name not in (*fields, SEED) and not name.startswith(skipped) and not here.runtime
            if compared and there.value != here.value:
                differing[f"{name} is {there.value} there, {here.value} here"] = None
    require(
        not differing,
        f"{out} holds a grid of another configuration ({'; '.join(differing)}); choose another --out, or vary these "
        f"fields with --grid",
    )
    # All other fields agree, so these values tell cells apart.
    names = {tuple(values_of(config, (*fields, SEED)).values()): name for name, config in before.cells.items()}
    cells = dict[str, Config]()
    for config in new.cells.values():
        values = values_of(config, fields)
        name = names.get((*values.values(), config.train.seed)) or cell_name(values, config.train.seed)
        cells[name] = config
    return Grid(fields, {**before.cells, **cells}), tuple(cells)


def read_grid(out: Path) -> Grid | None:
    """Reads a directory's ``grid.json``; returns None if there is none.

    Raises:
        ConfigError: the file is damaged or of another version.
    """
    path = out / FILE
    if not path.exists():
        return None
    try:
        saved = read_json(path)
        cells = {name: from_dict(Config, values) for name, values in saved["cells"].items()}
        return Grid(tuple(saved["fields"]), cells, saved["versions"])
    except (UserError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path}: damaged or of another version ({error}); choose another --out") from error


def add_cells(out: Path, new: Grid, choice: Choice) -> tuple[Grid, tuple[str, ...]]:
    """Writes ``grid.json`` with these cells added; a bad choice changes nothing.

    Returns:
        The whole grid, and the names of the chosen cells among the new ones.

    Raises:
        ConfigError: as for :func:`merge` and :meth:`Choice.of`.
    """
    with lock(out / ".locks" / "grid", wait=f"{out}: waiting for another command that writes {FILE}"):
        before = read_grid(out)
        grid, names = merge(before, new, out)
        chosen = choice.of(names)
        if before and before.versions != grid.versions:
            then, now = (", ".join(map(" ".join, each.versions.items())) for each in (before, grid))
            note(f"{out}: earlier cells may be of other versions ({then}; now {now})")
        cells = {name: to_dict(config) for name, config in grid.cells.items()}
        content = {"fields": grid.fields, "cells": cells, "versions": grid.versions}
        write_json(out / FILE, content)
    return grid, chosen
