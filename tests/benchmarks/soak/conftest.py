import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.soak.rounds import Stage, Target
from tests.benchmarks.soak import dummy

Dummies = Callable[..., Target]


@pytest.fixture
def target(tmp_path: Path) -> Dummies:
    """A command that only looks like training, about to be started: ``target(place, fault)``."""

    def make(place: Path = tmp_path, fault: str = "") -> Target:
        folder = place / "run" / "stage"
        folder.mkdir(parents=True)
        command = (sys.executable, str(dummy.__file__), str(folder), fault)
        return Target(command, (Stage(folder),), place / "output", dummy.EVERY * dummy.SECONDS, dummy.SECONDS)

    return make
