"""The log of a training run: JSON lines, TensorBoard, images, and Weights & Biases on request.

``log.jsonl`` is the record that a resumed run continues exactly; the others are views of it.
"""

import io
import json
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from rsjax.files import disk_guard, read_json_lines, write_file
from rsjax.training.tensorboard import TensorBoardWriter
from rsjax.training.wandb_run import WandbRun

NAME = "log.jsonl"
PICTURES = "pictures"
# Scalars that measure the machine: they differ between any two runs.
MEASURED = frozenset(
    {"seconds_per_step", "data_wait_share", "frames_per_second", "images_per_second"}
    | {"device_gib", "device_peak_gib", "host_gib"}
)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Reads a file of JSON lines, each with its ``step``. Returns [] if there is none; a torn last line is left out.

    Raises:
        FileError: the file cannot be read, or another line is damaged.
    """
    return read_json_lines(path, "step", int)


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """Writes a file of JSON lines as :func:`rsjax.files.write_file` does."""
    write_file(path, "".join(json.dumps(row) + "\n" for row in rows).encode())


def read_log(directory: Path) -> list[dict[str, Any]]:
    """Reads all logged steps: dicts of "step" and scalars. A step with validation scalars has a second row for them."""
    return read_rows(directory / NAME)


def read_curve(directory: Path) -> list[dict[str, Any]]:
    """Reads the log without machine measurements: an interrupted run gives the same rows as an uninterrupted one."""
    return [{k: v for k, v in row.items() if k not in MEASURED} for row in read_log(directory)]


class ScalarLog:
    """Appends to a directory's log, after cutting off the steps that a resumed run repeats.

    Args:
        directory: where ``log.jsonl``, ``tensorboard/``, ``pictures/`` and W&B's files go.
        start: the step after which the run resumes.
        wandb: the Weights & Biases project to log to as well; "": none.
        resume: False starts a new W&B run even if there is one.

    Raises:
        FileError: the disk is full.
        WandbError: Weights & Biases is missing or cannot start.
    """

    def __init__(self, directory: Path, start: int, wandb: str = "", resume: bool = True) -> None:
        self._directory = directory
        kept = [row for row in read_log(directory) if row["step"] <= start]
        with disk_guard(directory):
            write_rows(directory / NAME, kept)
            self._file = (directory / NAME).open("a")
            self._views: list[TensorBoardWriter | WandbRun] = [TensorBoardWriter(directory / "tensorboard", start)]
        if wandb:
            self._views.append(WandbRun(directory, wandb, resume))

    def write(self, step: int, scalars: dict[str, float]) -> None:
        """Logs scalars of one step.

        Raises:
            FileError: the disk is full.
        """
        with disk_guard(self._directory):
            self._file.write(json.dumps({"step": step} | scalars) + "\n")
            self._file.flush()
            for view in self._views:
                view.write(step, scalars)

    def image(self, step: int, name: str, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Logs an image, 0–255, and writes it to ``pictures/NAME-STEP.png``.

        Raises:
            FileError: the disk is full.
        """
        path = self._directory / PICTURES / f"{name}-{step:07d}.png"
        buffer = io.BytesIO()
        Image.fromarray(image).save(buffer, "PNG")
        with disk_guard(self._directory):
            write_file(path, buffer.getvalue())
            for view in self._views:
                view.image(step, name, image)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        def guard() -> AbstractContextManager[None]:
            # Errors here must not replace the one under way, which may be the same full disk.
            return disk_guard(self._directory) if kind is None else suppress(OSError)

        with guard():
            self._file.close()
        for view in self._views:
            with guard():
                view.close(failed=kind is not None)
