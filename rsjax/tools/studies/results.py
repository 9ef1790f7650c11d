"""The one reader of trained runs for studies: the state of each, its metrics, and their mean over seeds.

A run is one seed of a configuration. :class:`rsjax.evaluation.results.Result` is the file of one evaluation of a run;
:class:`RunResult` is what a study knows of a run, finished or not.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from rsjax.evaluation.results import load_evaluation
from rsjax.files import FileError, holder, is_held, read_json
from rsjax.models.base import create_model
from rsjax.tools.pipeline.run import Run
from rsjax.training.log import read_log

ERROR = "error.json"  # in the directory of a run that failed
FINAL_SHARE = 0.1  # share of the logged steps, at the end, over which a loss term is averaged
State = Literal["finished", "running", "failed", "interrupted", "missing"]


@dataclass(frozen=True)
class RunResult:
    """A run's state, and its metrics once it is finished.

    Attributes:
        reason: one line that says why there are no metrics.
        metrics: the numbers of ``metrics.json``, and the loss terms (``loss_rgb``, …) at the end of training.
        reasons: why a registered metric has no number, by name.
    """

    run: Run
    state: State
    reason: str
    metrics: Mapping[str, float]
    reasons: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The name of the run's directory."""
        return self.run.directory.name


class Spread(NamedTuple):
    """Mean and sample standard deviation (n - 1; None for one value) of n values."""

    mean: float
    std: float | None
    n: int


def spread(values: Sequence[float]) -> Spread:
    """Returns mean, sample standard deviation and count of one or more values."""
    std = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return Spread(float(np.mean(values)), std, len(values))


def read_run(run: Run) -> RunResult:
    """Reads a run's state and metrics; damaged files count as unfinished, and nothing is changed."""
    metrics = read_metrics(run)
    if metrics is not None:  # even while another command evaluates it again
        return RunResult(run, "finished", "", metrics, read_reasons(run))
    if is_held(run.lock_file):
        return RunResult(run, "running", f"in {holder(run.lock_file)}", {})
    with suppress(FileError):
        return RunResult(run, "failed", str(read_json(run.directory / ERROR).get("error")), {})
    if (run.directory / "config.json").exists():
        done = sum(run.finished(stage) for stage in run.stages)
        return RunResult(run, "interrupted", f"{done} of {len(run.stages)} stages are finished", {})
    return RunResult(run, "missing", "not started", {})


def read_metrics(run: Run) -> dict[str, float] | None:
    """Returns a run's metrics and final loss terms; None if the run is not finished or a file is damaged."""
    if not run.finished("report"):
        return None
    try:
        saved = read_json(run.directory / "metrics.json")
        log = read_log(run.directory / "world_model")
    except FileError:
        return None
    numbers = {name: float(value) for name, value in saved.items() if isinstance(value, int | float)}
    terms = tuple(create_model(run.config).loss_weights)
    return numbers | final_terms(log, terms)


def read_reasons(run: Run) -> dict[str, str]:
    """Returns why a run's ``metrics.json`` has no number for a metric, by name; empty if the file gives no reasons."""
    with suppress(FileError):
        reasons = read_json(run.directory / "metrics.json").get("reasons")
        return {name: str(reason) for name, reason in reasons.items()} if isinstance(reasons, dict) else {}
    return {}


def final_terms(log: Sequence[Mapping[str, Any]], terms: Sequence[str]) -> dict[str, float]:
    """Returns ``loss_<term>``: each term's mean over the last tenth of the logged steps (at least one)."""
    steps = [row for row in log if any(term in row for term in terms)]  # validation metrics are in separate rows
    last = steps[-max(1, round(FINAL_SHARE * len(steps))) :]
    values = {term: [row[term] for row in last if term in row] for term in terms}
    return {f"loss_{term}": float(np.mean(numbers)) for term, numbers in values.items() if numbers}


def read_per_clip(run: Run) -> dict[str, list[float]]:
    """Reads the scores of single clips in a run's own evaluation, by name.

    Raises:
        StoreError: the file is damaged.
        OSError: there is no file.
    """
    return load_evaluation(run.output("evaluation")).per_clip
