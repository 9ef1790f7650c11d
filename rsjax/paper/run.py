"""Runs the cells of a plan one after another, and writes the report after each."""

from collections import Counter
from pathlib import Path

from rsjax.ablation.sweep import run_cell
from rsjax.ablation.table import State, read_result
from rsjax.files import lock
from rsjax.paper.judge import judge_all
from rsjax.paper.measurements import measure
from rsjax.paper.plan import Cell, Plan
from rsjax.paper.report import write_report
from rsjax.pipeline.run import Run
from rsjax.progress import duration


def runs_of(plan: Plan, out: Path, data: Path) -> dict[str, Run]:
    """Returns the run of every cell by name, those left out too."""
    return {cell.name: Run(cell.config, out / "cells" / cell.name, data) for cell in (*plan.cells, *plan.left_out)}


def run_plan(plan: Plan, out: Path, data: Path, command: str) -> dict[str, State]:
    """Runs the cells that are not finished, measures them, and writes the report after each.

    A cell that fails is recorded and the next one starts. An interrupt or SIGTERM ends the command; the next one goes
    on where this one stopped.

    Args:
        out: the directory of cells and report.
        data: the directory of simulated data sets.
        command: how to repeat it, for the reports.

    Returns:
        The state of each cell by name.

    Raises:
        Preempted: SIGTERM; the unfinished cell is saved.
    """
    runs = runs_of(plan, out, data)
    states: dict[str, State] = {}
    mine = {cell.name: runs[cell.name] for cell in plan.cells}
    for number, cell in enumerate(plan.cells, 1):
        run = runs[cell.name]
        states[cell.name] = run_cell(cell.name, mine, out / "shared", (number, len(plan.cells)), command)
        if states[cell.name] == "finished":
            with lock(run.lock_file) as free:
                for name in measurements_of(plan, cell) if free else ():
                    measure(run, name)
        write(plan, out, data, command)
    return states


def measurements_of(plan: Plan, cell: Cell) -> tuple[str, ...]:
    """Returns the measurements that the claims need of a cell."""
    return tuple(
        dict.fromkeys(
            each.measurement
            for claim in plan.claims
            for each in claim.comparisons
            for use in cell.uses
            if each.measurement and use in ((claim.name, each.better), (claim.name, each.than))
        )
    )


def write(plan: Plan, out: Path, data: Path, command: str) -> Path:
    """Writes the report of what has finished so far, and returns the path of its page."""
    with lock(out / ".locks" / "report", wait="waiting for another process that writes the report"):
        return write_report(out, plan, judge_all(plan, runs_of(plan, out, data)), command)


def print_plan(plan: Plan, out: Path, data: Path) -> None:
    """Prints the cells in order with their states, estimated minutes and claims."""
    runs, base = runs_of(plan, out, data), plan.scale.base
    states = {cell.name: read_result(runs[cell.name]).state for cell in (*plan.cells, *plan.left_out)}
    print(
        f"{base.name} in {duration(plan.scale.seconds)}: {base.sim.episodes} episodes, {base.tokenizer_train.steps} "
        f"steps of the tokenizer, {base.train.steps} of the model, {base.eval.clips} test clips"
    )
    for cell in plan.cells:
        used = ", ".join(dict.fromkeys(claim for claim, _ in cell.uses))
        print(f"{cell.seconds / 60:6.1f} min  {states[cell.name]:11}  {cell.name}  ({used})")
    left = sum(cell.seconds for cell in plan.cells if states[cell.name] != "finished")
    counts = ", ".join(f"{count} {state}" for state, count in Counter(states[c.name] for c in plan.cells).items())
    print(f"{len(plan.cells)} cells ({counts}), about {duration(left)} to go at the speed of 2 cores of an AMD EPYC")
    if plan.left_out:
        print(f"{len(plan.left_out)} more need a larger --budget")
