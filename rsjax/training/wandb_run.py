"""Weights & Biases, an optional mirror of a training run's log."""

import importlib
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import UInt8

from rsjax.errors import UserError, first_line
from rsjax.files import FileError, read_json, write_json
from rsjax.progress import note

ID_FILE = "wandb.json"


class WandbError(UserError):
    """Weights & Biases is missing or cannot start. The message names the cure."""


def find_wandb() -> ModuleType:
    """Returns the ``wandb`` package.

    Raises:
        WandbError: it is not installed.
    """
    try:
        wandb = importlib.import_module("wandb")
        wandb.init  # noqa: B018  # a folder ./wandb, where W&B keeps its files, can be imported too
    except (ImportError, AttributeError) as error:
        raise WandbError("--wandb needs Weights & Biases; install it: pip install -e '.[wandb]'") from error
    return wandb


class WandbRun:
    """The Weights & Biases run of one trained stage, which continues after every interruption.

    Its id is in ``wandb.json`` next to the log. ``WANDB_MODE=offline`` keeps everything on disk. Once the run has
    started, an error of W&B never stops training: it is reported once, and the mirror stays off until the next start.

    Args:
        directory: the stage's; ``config.json`` in the directory above becomes W&B's configuration.
        project: W&B's project.
        resume: False starts a new W&B run.

    Raises:
        WandbError: the package is missing or cannot start.
    """

    def __init__(self, directory: Path, project: str, resume: bool = True) -> None:
        self._wandb = find_wandb()
        run_directory = directory.absolute().parent
        config = run_directory / "config.json"
        try:
            self._run = self._wandb.init(
                project=project,
                id=_run_id(directory / ID_FILE, project, resume),
                resume="allow",
                name=f"{run_directory.name}/{directory.name}",
                group=run_directory.name,
                job_type=directory.name,
                config=read_json(config) if config.exists() else {},
                dir=str(directory),
                settings=self._wandb.Settings(console="off", quiet=True),
            )
            # W&B's own step cannot go back, but after a kill the steps since the last checkpoint are logged again.
            self._run.define_metric("step")
            self._run.define_metric("*", step_metric="step")
        except Exception as error:  # W&B reports a missing or refused key and a missing network as errors of many types
            raise WandbError(
                f"Weights & Biases cannot start ({first_line(error)}); log in (wandb login), set WANDB_MODE=offline, "
                f"or leave --wandb out"
            ) from error
        note(f"Weights & Biases: {self._run.url or f'offline, {self._run.dir}'}")

    def write(self, step: int, scalars: dict[str, float]) -> None:
        """Logs scalars of one step."""
        self._guarded(lambda run: run.log({"step": step} | scalars))

    def image(self, step: int, name: str, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Logs an image, 0–255."""
        self._guarded(lambda run: run.log({"step": step, name: self._wandb.Image(image)}))

    def close(self, failed: bool) -> None:
        """Waits until W&B has everything; it shows the run as ``failed`` or finished."""
        self._guarded(lambda run: run.finish(exit_code=int(failed)))

    def _guarded(self, work: Callable[[Any], None]) -> None:
        if self._run is None:
            return
        try:
            work(self._run)
        except Exception as error:  # as above
            self._run = None
            note(f"Weights & Biases is off until the next start ({first_line(error)}); training continues")


def _run_id(path: Path, project: str, resume: bool) -> str:
    """Returns the id in the file if it belongs to this project; otherwise a new one, which it writes there."""
    with suppress(FileError):
        kept = read_json(path)
        if resume and kept.get("project") == project:
            return kept["id"]
    run_id = uuid.uuid4().hex[:12]
    write_json(path, {"project": project, "id": run_id})
    return run_id
