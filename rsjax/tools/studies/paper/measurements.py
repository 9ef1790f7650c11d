"""Measures scores of a trained run that its own evaluation lacks: on other clips, longer rollouts, with policies.

A measurement is a function that takes a run and returns a score per clip by name; claims refer to it by its name. It
runs once per run, and the result is kept in the run's directory.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rsjax.config import Config, require
from rsjax.errors import UserError
from rsjax.evaluation.registry import Unavailable
from rsjax.files import FileError, read_json, write_json
from rsjax.progress import note
from rsjax.tools.pipeline.run import Run
from rsjax.tools.studies.results import read_per_clip

Scores = Mapping[str, Sequence[float]]  # a number per clip, in the same order for all runs
Measurement = Callable[[Run], Scores]
Seconds = Callable[[Config], float]
FOLDER = "measured"

_MEASUREMENTS: dict[str, tuple[Measurement, Seconds]] = {}


def measurement(name: str, seconds: Seconds) -> Callable[[Measurement], Measurement]:
    """Registers a measurement under a name for :attr:`rsjax.tools.studies.paper.claim.ArmComparison.measurement`.

    Args:
        seconds: a function that estimates its time for a run with a configuration.

    Raises:
        ConfigError: another measurement has that name.
    """

    def register(function: Measurement) -> Measurement:
        require(name not in _MEASUREMENTS, f"two measurements are named {name!r}; rename one of them")
        _MEASUREMENTS[name] = function, seconds
        return function

    return register


def seconds_of(name: str, config: Config) -> float:
    """Returns the estimated seconds of a measurement."""
    return _MEASUREMENTS[name][1](config)


def measured(run: Run, name: str) -> bool:
    """Returns whether a run has the scores of a measurement."""
    with suppress(FileError):
        return "scores" in read_json(_path(run, name))
    return False


def measure(run: Run, name: str) -> None:
    """Measures a finished run unless this was done before; a failure is recorded, and the next command tries again.

    A measurement that does not exist for this run (:class:`rsjax.evaluation.registry.Unavailable`) is not tried again.
    """
    if measured(run, name):
        return
    result: dict[str, Any] = {}
    try:
        scores = _MEASUREMENTS[name][0](run)
        result["scores"] = {
            key: [float(x) if math.isfinite(x) else None for x in values] for key, values in scores.items()
        }
    except Unavailable as reason:
        result = {"scores": {}, "error": str(reason)}
    except Exception as error:
        line = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
        note(f"{name} failed: {line}")
        result["error"] = " ".join(line.split())
    write_json(_path(run, name), result)


def read_scores(run: Run, name: str) -> tuple[Scores, str]:
    """Returns the per-clip scores of a finished run, and the reason if there are none.

    Args:
        name: the name of a measurement; empty: the run's own evaluation.
    """
    try:
        if not name:
            return read_per_clip(run), ""
        saved = read_json(_path(run, name))
    except (UserError, OSError) as error:
        return {}, f"no {name or 'evaluation'} yet" if isinstance(error, (FileError, OSError)) else str(error)
    return saved.get("scores", {}), saved.get("error", "")


def _path(run: Run, name: str) -> Path:
    return run.directory / FOLDER / f"{name}.json"
