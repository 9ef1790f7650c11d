"""Scalar logs: JSON lines, one object a logged step, and TensorBoard beside them."""

import json
from pathlib import Path
from typing import Any, Self

from tensorboardX import SummaryWriter

from rsjax.data.store import disk_guard, write_atomically

NAME = "log.jsonl"


def read_log(directory: Path) -> list[dict[str, Any]]:
    """All logged steps: dicts of "step" and scalars. Empty where nothing was logged; a torn last line is left out."""
    path = directory / NAME
    rows = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            rows.append(json.loads(line))
        except ValueError:
            break  # killed while writing
    return rows


class ScalarLog:
    """Appends to a directory's log; what a resumed run will do again is cut off first.

    Args:
        directory: where ``log.jsonl`` and TensorBoard's files go.
        start: the step that the run resumes after.
    """

    def __init__(self, directory: Path, start: int) -> None:
        kept = [row for row in read_log(directory) if row["step"] <= start]
        with disk_guard(directory):
            write_atomically(directory / NAME, "".join(json.dumps(row) + "\n" for row in kept).encode())
            self._file = (directory / NAME).open("a")
            self._board = SummaryWriter(str(directory / "tensorboard"), purge_step=start + 1)

    def write(self, step: int, scalars: dict[str, float]) -> None:
        """Logs the scalars of one step."""
        with disk_guard(Path(self._file.name)):
            self._file.write(json.dumps({"step": step} | scalars) + "\n")
            self._file.flush()
        for name, value in scalars.items():
            self._board.add_scalar(name, value, step)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._board.close()
