"""Runs the cells of a grid one after another; any number of processes may do so at once, also on several machines."""

import json
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import jax

from rsjax.ablation.grid import Cell, Choice, idle
from rsjax.ablation.output import write_tables
from rsjax.ablation.record import extend, keep_record, read_record
from rsjax.ablation.results import ERROR, State, lock_of, read_metrics, run_of
from rsjax.ablation.shared import share
from rsjax.config import Config
from rsjax.errors import Preempted, UserError
from rsjax.files import lock, write_atomically
from rsjax.pipeline.stages import run_all
from rsjax.progress import note, stage


def run_grid(
    base: Config, cells: Sequence[Cell], choice: Choice, out: Path, data: Path, command: str = ""
) -> dict[str, State]:
    """Runs the chosen cells that are not finished, and writes the tables after each.

    A cell that fails is recorded and the next one begun. An interrupt or SIGTERM ends the command.

    Args:
        base: what the cells were made from.
        out: where the grid is kept, a run directory per cell.
        data: where data sets are kept.
        command: how to repeat it, for the cells' reports.

    Returns:
        What came of each chosen cell, by name. Those that another process works on are left to it ("running").

    Raises:
        GridError: ``out`` holds a grid of another configuration, or the choice fits no cell.
        Preempted: SIGTERM; the cell that was under way is saved.
    """
    choice.of(extend(read_record(out), base, cells, out)[1])  # a mistake in it leaves nothing behind
    record, ours = keep_record(out, base, cells)
    chosen = choice.of(ours)
    for line in idle(chosen):
        note(line)
    states: dict[str, State] = {}
    for number, cell in enumerate(chosen, 1):
        headline = partial(stage, number, len(chosen), cell.name)
        with lock(lock_of(cell, out)) as free:
            if free:
                states[cell.name] = _run_cell(cell, record.cells, out, data, command, headline)
            else:
                states[cell.name] = "running"
                headline("another process works on it, left to that one")
        write_tables(out, data)
    return states


def _run_cell(
    cell: Cell, every: Sequence[Cell], out: Path, data: Path, command: str, headline: Callable[[str], None]
) -> State:
    run = run_of(cell, out, data)
    failure = run.directory / ERROR
    if read_metrics(run) is not None:
        headline("finished, skipped")
        return "finished"
    headline(f"in {run.directory}")
    failure.unlink(missing_ok=True)
    if run.finished("report"):  # but its numbers are gone
        run.output("report").unlink()
    others = [run_of(other, out, data) for other in every if other.name != cell.name]
    try:
        run.prepare(overwrite=False)
        share(run, others, out / "shared")
        run_all(run, command=command)
    except Preempted:
        raise
    except Exception as error:
        _record_failure(failure, error)
        return "failed"
    finally:
        jax.clear_caches()  # a cell's compiled programs are its own; without this they pile up
    return "finished"


def _record_failure(path: Path, error: Exception) -> None:
    line = " ".join((str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}").split())
    note(f"failed: {line}")
    told = {"error": line, "time": time.strftime("%Y-%m-%d %H:%M:%S"), "traceback": traceback.format_exc()}
    with suppress(OSError):  # on a full disk it stands on the terminal alone; the cell then counts as interrupted
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(told, indent=1).encode())
