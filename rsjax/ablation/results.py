"""What a cell's directory tells: how far it has come, and its scores."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rsjax.ablation.grid import Cell
from rsjax.files import is_held
from rsjax.pipeline.run import STAGES, Run
from rsjax.training.log import read_log

ERROR = "error.json"  # in the directory of a cell that failed
FINAL_SHARE = 0.1  # of the logged steps, over which a loss term is averaged
State = Literal["finished", "running", "failed", "interrupted", "missing"]


@dataclass(frozen=True)
class Result:
    """A cell, its state, and its metrics where it is finished.

    Attributes:
        reason: one line on why there are none.
        metrics: those of ``metrics.json``, and ``loss_rgb`` … of the training's end.
    """

    cell: Cell
    state: State
    reason: str
    metrics: Mapping[str, float]


def run_of(cell: Cell, out: Path, data: Path) -> Run:
    """The cell's run."""
    return Run(cell.config, out / cell.name, data)


def lock_of(cell: Cell, out: Path) -> Path:
    """Of the lock that the process which works on the cell holds."""
    return out / ".locks" / f"cell-{cell.name}"


def read_result(cell: Cell, out: Path, data: Path) -> Result:
    """What there is of a cell. Whatever is damaged counts as unfinished; nothing is changed."""
    run = run_of(cell, out, data)
    if is_held(lock_of(cell, out)):
        return Result(cell, "running", "another process works on it", {})
    metrics = read_metrics(run)
    if metrics is not None:
        return Result(cell, "finished", "", metrics)
    error = _read_json(run.directory / ERROR)
    if error is not None:
        return Result(cell, "failed", str(error.get("error")), {})
    if run.directory.exists():
        done = sum(run.finished(stage) for stage in STAGES)
        return Result(cell, "interrupted", f"{done} of {len(STAGES)} stages are finished", {})
    return Result(cell, "missing", "not begun", {})


def read_metrics(run: Run) -> dict[str, float] | None:
    """The scores of a run and the end of its loss terms; None where it is not finished."""
    found = _read_json(run.directory / "metrics.json") if run.finished("report") else None
    if found is None:
        return None
    numbers = {name: float(value) for name, value in found.items() if isinstance(value, (int, float))}
    terms = run.config.loss.terms(run.config.model.depth)
    return numbers | final_terms(read_log(run.directory / "world_model"), tuple(terms))


def final_terms(log: list[dict[str, Any]], terms: tuple[str, ...]) -> dict[str, float]:
    """``loss_<term>``: each term's mean over the last tenth of the logged steps (at least one)."""
    log = [row for row in log if any(term in row for term in terms)]  # held-out scores have rows of their own
    last = log[-max(1, round(FINAL_SHARE * len(log))) :]
    values = {term: [row[term] for row in last if term in row] for term in terms}
    return {f"loss_{term}": float(np.mean(found)) for term, found in values.items() if found}


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None
