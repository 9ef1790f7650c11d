"""Carries out the tasks of a plan one after another, and writes the report after each task."""

from collections import Counter
from pathlib import Path

from rsjax.files import lock
from rsjax.progress import duration, stage
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.ablation.sweep import run_cell
from rsjax.tools.studies.paper.judge import judge_all
from rsjax.tools.studies.paper.measurements import measure, measured
from rsjax.tools.studies.paper.plan import Plan, Task
from rsjax.tools.studies.paper.report import write_report
from rsjax.tools.studies.results import State, read_run


def runs_of(plan: Plan, out: Path, data: Path) -> dict[str, Run]:
    """Returns the run of every cell by name."""
    return {cell.name: Run(cell.config, out / "cells" / cell.name, data) for cell in plan.cells.values()}


def run_plan(plan: Plan, out: Path, data: Path, command: str) -> dict[str, State]:
    """Carries out the tasks that are not done, and writes the report after each task.

    A cell that fails is recorded, and the next task begins. An interrupt or SIGTERM ends the command; the next command
    continues where this one stopped.

    Args:
        out: the directory of cells and report.
        data: the directory of simulated data sets.
        command: the command that repeats this, for the reports.

    Returns:
        The state of each cell by name.

    Raises:
        Preempted: SIGTERM; the unfinished cell is saved.
    """
    runs = runs_of(plan, out, data)
    states: dict[str, State] = {}
    for number, task in enumerate(plan.tasks, 1):
        place = (number, len(plan.tasks))
        run = runs[task.cell]
        if task.measurement:
            with lock(run.lock_file) as free:
                if not free or not run.finished("report"):
                    stage(*place, task.cell, f"{task.measurement}: left out, as its training is not finished")
                elif measured(run, task.measurement):
                    stage(*place, task.cell, f"{task.measurement}: up to date, skipped")
                else:
                    stage(*place, task.cell, task.measurement)
                    measure(run, task.measurement)
        else:
            states[task.cell] = run_cell(task.cell, runs, out / "shared", place, command)
        write(plan, out, data, command)
    return states


def write(plan: Plan, out: Path, data: Path, command: str) -> Path:
    """Writes the report on the results so far, and returns the path of its page."""
    with lock(out / ".locks" / "report", wait="waiting for another process that writes the report"):
        return write_report(out, plan, judge_all(plan, runs_of(plan, out, data)), command)


def print_plan(plan: Plan, out: Path, data: Path) -> None:
    """Prints the tasks in order with their states, estimated minutes and claims."""
    runs = runs_of(plan, out, data)
    base = plan.scale.base
    print(
        f"{base.name} in {duration(plan.scale.seconds)}: {base.sim.episodes} episodes, {base.tokenizer_train.steps} "
        f"steps of the tokenizer, {base.train.steps} of the model, {base.eval.clips} test clips"
    )
    for (claim, arm), reason in plan.absent.items():
        print(f"{claim}: {arm} is left out: {reason}")
    states: dict[Task, State] = {}
    for task in plan.tasks:
        run = runs[task.cell]
        if not task.measurement:
            states[task] = read_run(run).state
        elif measured(run, task.measurement):
            states[task] = "finished"
        else:
            states[task] = "missing"
    for task, state in states.items():
        what = f"{task.cell}: {task.measurement}" if task.measurement else task.cell
        print(f"{task.seconds / 60:6.1f} min  {state:11}  {what}  ({task.claim})")
    left = sum(task.seconds for task, state in states.items() if state != "finished")
    counts = ", ".join(f"{count} {state}" for state, count in Counter(states.values()).items())
    print(f"{len(plan.tasks)} tasks ({counts}), about {duration(left)} to go at the speed of 2 cores of an AMD EPYC")
    if plan.left_out:
        print(f"{len(plan.left_out)} more need a larger --budget")
