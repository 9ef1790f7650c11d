"""The steps that training skipped because their loss or gradient was not finite, with the data to replay them."""

from pathlib import Path
from typing import Any

from rsjax.training.log import read_rows, write_rows

NAME = "skipped.jsonl"


def read_skipped(directory: Path) -> list[dict[str, Any]]:
    """Reads the skipped steps of a training stage.

    Returns:
        A dict for each: ``step``; ``loss`` and ``grad_norm`` as text, because JSON has no NaN; ``records``, the clips'
        files and origins; ``data``, the loader's state before the batch, from which
        :meth:`rsjax.data.curriculum.LoaderFactory.replay` reads it again.
    """
    return read_rows(directory / NAME)


class SkippedSteps:
    """Keeps ``skipped.jsonl`` in a training stage's directory; without a skipped step there is no file.

    Args:
        start: the step after which the run resumes; later lines are cut off.
    """

    def __init__(self, directory: Path, start: int) -> None:
        self._path = directory / NAME
        self._rows = [row for row in read_skipped(directory) if row["step"] <= start]
        if self._path.exists():
            write_rows(self._path, self._rows)

    def add(self, step: int, scalars: dict[str, float], records: list[dict[str, Any]], data: dict[str, Any]) -> None:
        """Adds a step.

        Raises:
            FileError: the disk is full.
        """
        reason = {name: str(scalars[name]) for name in ("loss", "grad_norm")}
        self._rows.append({"step": step, **reason, "records": records, "data": data})
        write_rows(self._path, self._rows)
