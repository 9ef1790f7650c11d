"""What a training run writes down as it goes: JSON lines, TensorBoard, pictures, and Weights & Biases where asked for.

``log.jsonl`` is the record that resumes exactly; the others are views of it.
"""

import io
import json
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from rsjax.files import disk_guard, write_atomically
from rsjax.training.tensorboard import Board
from rsjax.training.wandb_run import WandbRun

NAME = "log.jsonl"
PICTURES = "pictures"
# Scalars that measure the machine: no two runs agree on them.
MEASURED = frozenset(
    {
        "seconds_per_step",
        "data_wait_share",
        "tokens_per_second",
        "images_per_second",
        "device_gib",
        "device_peak_gib",
        "host_gib",
    }
)


def read_log(directory: Path) -> list[dict[str, Any]]:
    """All logged steps: dicts of "step" and scalars. Empty where nothing was logged; a torn last line is left out.

    A step has two rows where its held-out scalars were written too.
    """
    path = directory / NAME
    rows = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            rows.append(json.loads(line))
        except ValueError:
            break  # killed while writing
    return rows


def read_curve(directory: Path) -> list[dict[str, Any]]:
    """:func:`read_log` without what measures the machine: equal for a run that was stopped and one that was not."""
    return [{k: v for k, v in row.items() if k not in MEASURED} for row in read_log(directory)]


class ScalarLog:
    """Appends to a directory's log; what a resumed run will do again is cut off first.

    Args:
        directory: where ``log.jsonl``, ``tensorboard/``, ``pictures/`` and W&B's files go.
        start: the step that the run resumes after.
        wandb: the Weights & Biases project to log to as well; none where it is empty.
        resume: False begins a new W&B run where there was one.

    Raises:
        StoreError: the disk is full.
        WandbError: Weights & Biases is missing or cannot start.
    """

    def __init__(self, directory: Path, start: int, wandb: str = "", resume: bool = True) -> None:
        self._directory = directory
        kept = [row for row in read_log(directory) if row["step"] <= start]
        with disk_guard(directory):
            write_atomically(directory / NAME, "".join(json.dumps(row) + "\n" for row in kept).encode())
            self._file = (directory / NAME).open("a")
            self._boards: list[Board | WandbRun] = [Board(directory / "tensorboard", start)]
        if wandb:
            self._boards.append(WandbRun(directory, wandb, resume))

    def write(self, step: int, scalars: dict[str, float]) -> None:
        """Logs scalars of one step.

        Raises:
            StoreError: the disk is full.
        """
        with disk_guard(self._directory):
            self._file.write(json.dumps({"step": step} | scalars) + "\n")
            self._file.flush()
            for board in self._boards:
                board.write(step, scalars)

    def image(self, step: int, name: str, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Shows a picture, 0–255, and keeps it as ``pictures/NAME-STEP.png``; a file name's characters only.

        Raises:
            StoreError: the disk is full.
        """
        path = self._directory / PICTURES / f"{name}-{step:07d}.png"
        with disk_guard(self._directory):
            path.parent.mkdir(exist_ok=True)
            write_atomically(path, _png(image))
            for board in self._boards:
                board.image(step, name, image)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        closes: list[Callable[[], None]] = [partial(board.close, failed=kind is not None) for board in self._boards]
        for close in (self._file.close, *closes):
            # The error that is under way counts; a full disk would be told a second time.
            with disk_guard(self._directory) if kind is None else suppress(OSError):
                close()


def _png(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()
