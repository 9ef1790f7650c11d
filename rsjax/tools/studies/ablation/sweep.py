"""Runs the cells of a grid one after another; any number of processes may work on it at once, on several machines.

What several cells need is made once. The clips are stored outside the runs. A tokenizer, its tokens and, if cells
differ only in how they are sampled or scored, the world model are made under ``shared``, each in a run directory named
by its content key. They are put into the cells as hard links, so every cell is a complete run directory, which can be
moved, resumed or deleted on its own, and no file takes disk space twice.
"""

import os
import shutil
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from rsjax.config import require
from rsjax.data.token_sets import OWN
from rsjax.errors import UserError
from rsjax.files import FileError, disk_guard, holder, lock, write_atomically, write_json
from rsjax.progress import note, stage
from rsjax.runtime import drop_compiled_programs
from rsjax.tools.pipeline import stages
from rsjax.tools.pipeline.run import Run, link
from rsjax.tools.studies.ablation.figure import draw
from rsjax.tools.studies.ablation.grid import FILE, Choice, Grid, add_cells, merge, read_grid, repeated_cells
from rsjax.tools.studies.ablation.table import Row, as_csv, as_json, as_markdown, shown_columns, tabulate
from rsjax.tools.studies.results import ERROR, State, read_metrics, read_run

PIECES_OF_PROGRAMS = 10_000  # of mapped memory, about 2 GB; a cell's programs take some thousands
SHARED = ("tokenizer", "tokens", "world_model")  # each stage needs the stages before it


def run_sweep(new: Grid, choice: Choice, out: Path, data: Path, command: str = "") -> dict[str, State]:
    """Adds cells to a directory, runs the chosen ones that are not finished, and writes the tables after each cell.

    A cell that fails is recorded, and the next one starts. An interrupt or SIGTERM ends the command.

    Args:
        out: the grid's directory, with a run directory per cell.
        data: the directory of simulated data sets.
        command: the command that repeats the sweep, for the cells' reports.

    Returns:
        The state of each chosen cell, by name; "running" if another process runs it.

    Raises:
        ConfigError: ``out`` contains a grid of another configuration, or the choice matches no cell.
        Preempted: SIGTERM; the unfinished cell is saved.
    """
    grid, chosen = add_cells(out, new, choice)
    for line in repeated_cells(grid):
        note(line)
    runs = runs_of(grid, out, data)
    states: dict[str, State] = {}
    for number, name in enumerate(chosen, 1):
        states[name] = run_cell(name, runs, out / "shared", (number, len(chosen)), command)
        write_tables(out, data)
    return states


def runs_of(grid: Grid, out: Path, data: Path) -> dict[str, Run]:
    """Returns the run of every cell, by name."""
    return {name: Run(config, out / name, data) for name, config in grid.cells.items()}


def run_cell(name: str, runs: Mapping[str, Run], shared: Path, place: tuple[int, int], command: str) -> State:
    """Runs a cell unless it is finished or another process runs it. A failure is recorded in its ``error.json``.

    Args:
        name: the cell's name among ``runs``; it may take the stages that it has in common with the others.
        shared: the directory where shared stages are made and kept.
        place: the cell's number and the number of cells, for the headline.
        command: the command that repeats the sweep, for the report.

    Returns:
        The cell's state; "running" if another process runs it.

    Raises:
        Preempted: SIGTERM; the unfinished cell is saved.
    """
    run = runs[name]
    with lock(run.lock_file) as free:
        if not free:
            stage(*place, name, f"left to {holder(run.lock_file)}, which runs it")
            return "running"
        if read_metrics(run) is not None:
            stage(*place, name, "finished, skipped")
            return "finished"
        stage(*place, name, f"in {run.directory}")
        failure = run.directory / ERROR
        failure.unlink(missing_ok=True)
        if run.finished("report"):  # but its metrics.json is gone
            run.output("report").unlink()
        try:
            run.prepare(overwrite=False)
            share(run, [other for other in runs.values() if other is not run], shared)
            stages.run_all(run, command=command)
        except Exception as error:
            line = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
            line = " ".join(line.split())
            note(f"failed: {line}")
            record = {"error": line, "time": time.strftime("%Y-%m-%d %H:%M:%S"), "traceback": traceback.format_exc()}
            with suppress(FileError):  # on a full disk, only the terminal shows the error; the cell is interrupted
                write_json(failure, record)
            return "failed"
        finally:
            # Cells that differ in their seeds alone run the same programs, those of other cells accumulate.
            drop_compiled_programs(PIECES_OF_PROGRAMS)
        return "finished"


def share(run: Run, others: Sequence[Run], shared: Path) -> None:
    """Gives a cell's run the stages that it has in common with others, and makes those that do not exist yet.

    A stage is taken from any run in the same directory that has finished it, also from a run of an earlier command, if
    the mark of its stage has the same content key. Processes that need the same stage wait for the one that makes it.
    If that process is killed, the next one continues from its checkpoints.

    Args:
        others: the other cells' runs; a world model is made under ``shared`` only if one of them needs the same.
        shared: the directory where shared stages are made and kept.
    """
    if not run.finished("collect"):
        with run.stage("collect"):
            stages.collect_clips(run)
    cells = [path for path in sorted(run.directory.parent.iterdir()) if path.is_dir() and path != run.directory]
    beside = [replace(run, directory=path) for path in cells]
    for name in (name for name in SHARED if name in run.stages and not run.finished(name)):
        source = next((source for source in beside if source.finished(name)), None)
        if source is not None:
            link_stage(source, run, name)
            continue
        key = run.keys()[name]
        if name == "world_model" and all(other.keys().get(name) != key for other in others):
            continue
        maker = Run(run.config, shared / f"{name}-{key}", run.data_directory)
        with lock(maker.lock_file, wait=f"waiting for another process that makes the {name}"):
            if not maker.finished(name):
                maker.prepare(overwrite=False)
                for before in SHARED[: SHARED.index(name)]:
                    if before in run.stages:
                        link_stage(run, maker, before)
                note(f"for all cells that share it, in {maker.directory}: {name.replace('_', ' ')}")
                with maker.stage(name):
                    if name == "tokenizer":
                        stages.train_tokenizer(maker, resume=True)
                    elif name == "world_model":
                        stages.train_world_model(maker, resume=True)
                    else:
                        stages.prepare(maker)
            link_stage(maker, run, name)


def link_stage(source: Run, run: Run, name: str) -> None:
    """Puts a finished stage of one run into another run, where it appears at once and complete, without checkpoints.

    The stage's output never changes, so it is hard-linked, as are the tokens that the stage itself keeps (``OWN``);
    logs and marks are copied.
    """
    if run.finished(name):
        return
    target = run.directory / name
    temporary = run.directory / f"{name}.linking"
    folder = source.directory / name
    output = source.output(name)
    ignored = shutil.ignore_patterns("checkpoints", ".*.lock")

    def copy(path: str, to: str) -> None:
        if {output, folder / OWN}.isdisjoint(Path(path).parents):
            shutil.copy2(path, to)
            return
        try:
            os.link(path, to)
        except OSError:  # another file system, or one without hard links
            shutil.copy2(path, to)

    with disk_guard(temporary):
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.copytree(folder, temporary, symlinks=True, ignore=ignored, copy_function=copy)
        if output.is_symlink() and (own := output.resolve()).is_relative_to(folder.resolve()):
            link(target.absolute() / own.relative_to(folder.resolve()), temporary / output.name)
        shutil.rmtree(target, ignore_errors=True)
        temporary.rename(target)


def write_tables(out: Path, data: Path) -> list[Row]:
    """Writes ``table.md``, ``.csv``, ``.json`` and ``.png`` of all cells in ``grid.json`` as they are now.

    If several processes write, the last one to write has also read last, so the files are never out of date.

    Raises:
        ConfigError: ``out`` contains no grid.
        FileError: the disk is full.
    """
    require((out / FILE).exists(), f"{out} holds no grid ({FILE}); choose its directory with --out, or run it first")
    with lock(out / ".locks" / "table", wait="waiting for another process that writes the table"), disk_guard(out):
        grid = read_grid(out)
        assert grid is not None
        runs = runs_of(grid, out, data).values()
        rows = tabulate(map(read_run, runs), grid.fields)
        write_atomically(out / "table.md", as_markdown(rows).encode())
        write_atomically(out / "table.csv", as_csv(rows).encode())
        write_json(out / "table.json", as_json(rows))
        title = f"{next(iter(runs)).config.name}: {out.name}"
        write_atomically(out / "table.png", draw(rows, shown_columns(rows), title))
    return rows


def print_table(out: Path, data: Path) -> None:
    """Writes the tables, and prints the table and the paths of the files. Errors as in :func:`write_tables`."""
    print(f"\n{as_markdown(write_tables(out, data))}")
    print(f"table: {(out / 'table.md').absolute()} (and .csv, .json)\npicture: {(out / 'table.png').absolute()}")


def print_cells(new: Grid, choice: Choice, out: Path, data: Path) -> None:
    """Prints the chosen cells with their numbers and states, and writes nothing. Errors as in :func:`run_sweep`."""
    grid, names = merge(read_grid(out), new, out)
    chosen = choice.of(names)
    runs = runs_of(grid, out, data)
    for number, name in enumerate(names):
        if name in chosen:
            print(f"{number:4}  {read_run(runs[name]).state:11}  {name}")
