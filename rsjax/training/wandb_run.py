"""Weights & Biases, an optional mirror of a training run's log."""

import importlib
import json
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from rsjax.errors import UserError, first_line
from rsjax.files import write_atomically
from rsjax.progress import note

ID_FILE = "wandb.json"


class WandbError(UserError):
    """Weights & Biases is missing or cannot start. The message says what to do."""


def find_wandb() -> Any:
    """The ``wandb`` package.

    Raises:
        WandbError: it is not installed.
    """
    try:
        wandb = importlib.import_module("wandb")
        wandb.init  # noqa: B018  # a directory ./wandb, where W&B keeps its files, can be imported too
    except (ImportError, AttributeError) as error:
        raise WandbError("--wandb needs Weights & Biases; install it: pip install 'rsjax[wandb]'") from error
    return wandb


class WandbRun:
    """One Weights & Biases run for one trained stage of a run directory, gone on with after every interruption.

    Its id is kept in ``wandb.json`` beside the log. ``WANDB_MODE=offline`` keeps everything on disk. Once it runs, an
    error of W&B never stops the training: it is told once, and the mirror stays off until the next start.

    Args:
        directory: the stage's; ``config.json`` in the directory above becomes W&B's configuration.
        project: W&B's project.
        resume: False begins a new W&B run.

    Raises:
        WandbError: the package is missing or refuses to start.
    """

    def __init__(self, directory: Path, project: str, resume: bool = True) -> None:
        self._wandb = find_wandb()
        run_directory = directory.absolute().parent
        try:
            self._run = self._wandb.init(
                project=project,
                id=_run_id(directory / ID_FILE, project, resume),
                resume="allow",
                name=f"{run_directory.name}/{directory.name}",
                group=run_directory.name,
                job_type=directory.name,
                config=_settings(run_directory / "config.json"),
                dir=str(directory),
                settings=self._wandb.Settings(console="off", quiet=True),
            )
            # Not W&B's own step, which cannot go back: after a kill the steps since the last checkpoint come again.
            self._run.define_metric("step")
            self._run.define_metric("*", step_metric="step")
        except Exception as error:  # W&B reports a missing key, a refused one and a missing network as many types
            raise WandbError(
                f"Weights & Biases cannot start ({first_line(error)}); log in (wandb login), set WANDB_MODE=offline, "
                f"or leave --wandb out"
            ) from error
        note(f"Weights & Biases: {self._run.url or f'offline, {self._run.dir}'}")

    def write(self, step: int, scalars: dict[str, float]) -> None:
        """Adds scalars of one step."""
        self._guarded(lambda run: run.log({"step": step} | scalars))

    def image(self, step: int, name: str, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Adds a picture, 0–255."""
        self._guarded(lambda run: run.log({"step": step, name: self._wandb.Image(image)}))

    def close(self, failed: bool) -> None:
        """Waits until W&B has what it was given.

        Args:
            failed: the run ends with an error, and W&B shows it so.
        """
        self._guarded(lambda run: run.finish(exit_code=int(failed)))

    def _guarded(self, work: Callable[[Any], Any]) -> None:
        if self._run is None:
            return
        try:
            work(self._run)
        except Exception as error:  # as above
            self._run = None
            note(f"Weights & Biases is off until the next start ({first_line(error)}); training goes on")


def _run_id(path: Path, project: str, resume: bool) -> str:
    """The id in the file, where it is of this project; else a new one, which is kept there."""
    try:
        kept = json.loads(path.read_text())
    except (OSError, ValueError):
        kept = {}
    if resume and kept.get("project") == project:
        return kept["id"]
    run_id = uuid.uuid4().hex[:12]
    write_atomically(path, json.dumps({"project": project, "id": run_id}).encode())
    return run_id


def _settings(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text()) if path.exists() else {}
