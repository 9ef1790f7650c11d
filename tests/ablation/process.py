"""A grid of toys in a process of its own: ``python -m tests.ablation.process PLACE OUT DATA RECORD``.

PLACE is a stage, in the midst of which the process kills itself, or ``link`` (a shared stage is half linked), or
``never``; then every stage takes a moment, so that two processes meet.
"""

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from rsjax.ablation import runner, shared
from rsjax.ablation.grid import Choice
from tests.ablation import toy

AXES = ("loss.keypoints=True,False", "tokenizer_train.entropy=0.1,0.2", "model.depth=True,False")


def die(*_: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def main(place: str, out: Path, data: Path, record: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        toy.stub_stages(patch, record)
        if place == "link":
            patch.setattr(shared, "_place", die)
        log = toy.log

        def slow_or_deadly(directory: Path, word: str) -> None:
            if word.startswith(f"{place} "):
                die()
            time.sleep(0.05)
            log(directory, word)

        patch.setattr(toy, "log", slow_or_deadly)
        runner.run_grid(toy.DEBUG, toy.cells(*AXES), Choice(), out, data)


if __name__ == "__main__":
    main(sys.argv[1], *map(Path, sys.argv[2:]))
