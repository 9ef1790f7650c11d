"""Sweeps of toys in processes of their own: ``python -m tests.tools.studies.ablation.process DIRECTORY``.

It starts four (forks, so that libraries are imported once): two work on DIRECTORY/together at once; one kills itself
in the middle of a shared stage in DIRECTORY/tokens, one in the middle of linking it in DIRECTORY/link. Their exit codes
are printed as JSON, by directory; what they print lies beside the directories.
"""

import json
import os
import signal
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import pytest

from rsjax.tools.studies.ablation import sweep
from rsjax.tools.studies.ablation.grid import Choice
from tests.tools.studies.ablation import toy

AXES = ("model.loss.keypoints=printed,none", "tokenizer_train.entropy_weight=0.1,0.2")
SCENARIOS = ("together", "together", "tokens", "link")


def die(*_: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def run(place: str, directory: Path) -> None:
    """Every stage takes a moment, so that two processes meet."""
    directory.mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        toy.stub_stages(patch, directory)
        if place == "link":
            patch.setattr(os, "link", die)
        log = toy.log

        def slow_or_deadly(record: Path, word: str) -> None:
            if word.startswith(f"{place} "):
                die()
            time.sleep(0.05)
            log(record, word)

        patch.setattr(toy, "log", slow_or_deadly)
        sweep.run_sweep(toy.grid(*AXES), Choice(), directory / "out", directory / "data")


def fork(number: int, place: str, base: Path) -> int:
    if child := os.fork():
        return child
    try:
        output = os.open(base / f"output-{number}", os.O_WRONLY | os.O_CREAT)
        os.dup2(output, 1)
        run(place, base / place)
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    sys.stdout.flush()
    os._exit(0)


def main(base: Path) -> None:
    children = [(place, fork(number, place, base)) for number, place in enumerate(SCENARIOS)]
    codes: dict[str, list[int]] = {place: [] for place in SCENARIOS}
    for place, child in children:
        codes[place].append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    print(json.dumps(codes))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
