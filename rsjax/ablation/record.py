"""``grid.json``: all cells that a directory holds or is to hold, over all commands that were given for it."""

import importlib.metadata
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsjax.ablation.fields import GridError, Value, leaves
from rsjax.ablation.grid import SEED, Cell, make_cell
from rsjax.config import Config, ConfigError, from_dict, to_dict
from rsjax.files import disk_guard, lock, write_atomically
from rsjax.progress import note

FILE = "grid.json"
LIBRARIES = ("rsjax", "jax", "flax", "optax", "numpy")


@dataclass(frozen=True)
class Record:
    """A grid's directory as its file tells.

    Attributes:
        base: what all cells share; the fields that vary have any value here.
        fields: that vary, by dotted name; every cell has a value of each.
        cells: in the order in which they were asked for.
        versions: library → version of the command that wrote the file.
    """

    base: Config
    fields: tuple[str, ...]
    cells: tuple[Cell, ...]
    versions: dict[str, str]


def read_record(out: Path) -> Record | None:
    """What the directory's file tells; None where there is none.

    Raises:
        GridError: the file is damaged or of another version.
    """
    path = out / FILE
    if not path.exists():
        return None
    try:
        saved = json.loads(path.read_text())
        base = from_dict(Config, saved["config"])
        cells = tuple(make_cell(base, cell["values"], cell["seed"], cell["name"]) for cell in saved["cells"])
        return Record(base, tuple(saved["fields"]), cells, saved["versions"])
    except (ConfigError, ValueError, KeyError, TypeError) as error:
        raise GridError(f"{path}: damaged or of another version ({error}); choose another --out") from error


def extend(before: Record | None, base: Config, cells: Sequence[Cell], out: Path) -> tuple[Record, tuple[Cell, ...]]:
    """The directory's record with these cells in it, and these cells as they are called there.

    A cell of the same values as an earlier one is that one. Cells from before a field was varied have the value that
    this field had then.

    Args:
        before: the record until now.
        base: what the new cells were made from.
        out: the directory, for errors.

    Raises:
        GridError: the earlier cells were made from another configuration; the message names the differing fields.
    """
    fields = before.fields if before else ()
    fields += tuple(name for name in cells[0].values if name not in fields)
    if before:
        _check_same(before.base, base, fields, out)
    merged: dict[tuple[Value, ...], Cell] = {}
    for cell in before.cells if before else ():
        values = _values(cell, fields)
        merged[(*values.values(), cell.seed)] = make_cell(base, values, cell.seed, cell.name)
    ours = []
    for cell in cells:
        values = _values(cell, fields)
        ours.append(merged.setdefault((*values.values(), cell.seed), make_cell(base, values, cell.seed)))
    return Record(base, fields, tuple(merged.values()), _versions()), tuple(ours)


def keep_record(out: Path, base: Config, cells: Sequence[Cell]) -> tuple[Record, tuple[Cell, ...]]:
    """As :func:`extend` the directory's own record, which is written too; it appears whole, one command at a time."""
    with lock(out / ".locks" / "grid", wait=f"{out}: waiting for another command that writes {FILE}"):
        before = read_record(out)
        record, ours = extend(before, base, cells, out)
        if before and before.versions != record.versions:
            then, now = _text(before.versions), _text(record.versions)
            note(f"{out}: earlier cells may be of other versions ({then}; now {now})")
        with disk_guard(out):
            write_atomically(out / FILE, json.dumps(_to_json(record), indent=1).encode())
    return record, ours


def _to_json(record: Record) -> dict[str, Any]:
    cells = [{"name": cell.name, "values": dict(cell.values), "seed": cell.seed} for cell in record.cells]
    axes = {field: list(dict.fromkeys(cell.values[field] for cell in record.cells)) for field in record.fields}
    seeds = list(dict.fromkeys(cell.seed for cell in record.cells))
    return {
        "fields": list(record.fields),
        "values": axes,
        "seeds": seeds,
        "cells": cells,
        "config": to_dict(record.base),
        "versions": record.versions,
    }


def _values(cell: Cell, fields: Sequence[str]) -> dict[str, Value]:
    known = leaves(cell.config)
    return {field: known[field].value for field in fields}


def _check_same(there: Config, here: Config, fields: Sequence[str], out: Path) -> None:
    """The configurations may differ in what is varied, in the seed, and in how runs are carried out."""
    old, new = leaves(there), leaves(here)
    differing = [
        f"{name} is {old[name].value} there, {leaf.value} here"
        for name, leaf in new.items()
        if leaf.value != old[name].value and not leaf.runtime and name not in (*fields, SEED)
    ]
    if differing:
        raise GridError(
            f"{out} holds a grid of another configuration ({'; '.join(differing)}); choose another --out, or vary "
            f"these fields with --grid"
        )


def _text(versions: dict[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions.items())


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in LIBRARIES}
