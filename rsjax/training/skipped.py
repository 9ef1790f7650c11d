"""Steps that were left out because their loss or gradient was not finite, with what is needed to replay them."""

import json
from pathlib import Path
from typing import Any

from rsjax.files import disk_guard, write_atomically

NAME = "skipped.jsonl"


def read_skipped(directory: Path) -> list[dict[str, Any]]:
    """The steps that a training stage left out, one dict each.

    Keys: ``step``; ``loss`` and ``grad_norm`` as text, for JSON has no NaN; ``records``, where the clips lie and come
    from; ``data``, the loader's state before the batch: given to
    :meth:`rsjax.data.curriculum.LoaderFactory.replay`, the batch comes back.
    """
    path = directory / NAME
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


class SkippedSteps:
    """Keeps ``skipped.jsonl`` in a training stage's directory, where a step was left out; later lines are cut off.

    Args:
        start: the step that the run resumes after.
    """

    def __init__(self, directory: Path, start: int) -> None:
        self._path = directory / NAME
        self._rows = [row for row in read_skipped(directory) if row["step"] <= start]
        if self._path.exists():
            self._write()

    def add(self, step: int, scalars: dict[str, float], records: list[dict[str, Any]], data: dict[str, Any]) -> None:
        """Writes one step down.

        Raises:
            StoreError: the disk is full.
        """
        told = {name: str(scalars[name]) for name in ("loss", "grad_norm")}
        self._rows.append({"step": step, **told, "records": records, "data": data})
        self._write()

    def _write(self) -> None:
        with disk_guard(self._path):
            write_atomically(self._path, "".join(json.dumps(row) + "\n" for row in self._rows).encode())
