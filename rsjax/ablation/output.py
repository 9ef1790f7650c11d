"""A grid's table and its list of cells, as files and on the terminal."""

import json
from collections.abc import Sequence
from pathlib import Path

from rsjax.ablation.fields import GridError
from rsjax.ablation.figure import draw
from rsjax.ablation.grid import Cell, Choice
from rsjax.ablation.record import FILE, Record, extend, read_record
from rsjax.ablation.results import read_result
from rsjax.ablation.table import Row, as_csv, as_json, markdown, tabulate
from rsjax.config import Config
from rsjax.files import disk_guard, lock, write_atomically


def write_tables(out: Path, data: Path) -> list[Row]:
    """Writes ``table.md``, ``table.csv``, ``table.json`` and ``table.png`` from what the cells' directories tell now.

    Of several processes that do so the last one has read last: the files never fall behind.

    Args:
        out: the grid's directory; all cells of its ``grid.json`` are in the tables.
        data: where data sets are kept.

    Raises:
        GridError: there is no grid.
        StoreError: the disk is full.
    """
    _record(out)
    with lock(out / ".locks" / "table", wait="waiting for another process that writes the table"), disk_guard(out):
        record = _record(out)
        rows = tabulate([read_result(cell, out, data) for cell in record.cells])
        write_atomically(out / "table.md", markdown(rows).encode())
        write_atomically(out / "table.csv", as_csv(rows).encode())
        write_atomically(out / "table.json", json.dumps(as_json(rows), indent=1).encode())
        write_atomically(out / "table.png", draw(rows, f"{record.base.name}: {out.name}"))
    return rows


def _record(out: Path) -> Record:
    record = read_record(out)
    if record is None:
        raise GridError(f"{out} holds no grid ({FILE}); choose its directory with --out, or run it first")
    return record


def print_table(out: Path, data: Path) -> None:
    """Writes the files, and prints the table and where they are. Arguments and errors as :func:`write_tables`."""
    print(f"\n{markdown(write_tables(out, data))}")
    print(f"table: {(out / 'table.md').absolute()} (and .csv, .json)\npicture: {(out / 'table.png').absolute()}")


def print_cells(base: Config, cells: Sequence[Cell], choice: Choice, out: Path, data: Path) -> None:
    """Prints the chosen cells with their numbers and how far they are. Nothing is written.

    Args:
        base: what the cells were made from.

    Raises:
        GridError: ``out`` holds a grid of another configuration, or the choice fits no cell.
    """
    _, ours = extend(read_record(out), base, cells, out)
    chosen = {cell.name for cell in choice.of(ours)}
    for number, cell in enumerate(ours):
        if cell.name in chosen:
            print(f"{number:4}  {read_result(cell, out, data).state:11}  {cell.name}")
