import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.soak.rounds import Stage, Target, run_without_faults
from tests.reliability.program import make_store
from tests.tools.pipeline.conftest import command, debug, shared

__all__ = ["command", "debug", "shared"]

Targets = Callable[..., Target]
STEP_SECONDS, EVERY, STEPS = 0.025, 10, 60


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "store"
    make_store(path)
    return path


@pytest.fixture
def target(store: Path, tmp_path: Path) -> Targets:
    """A small program that trains, about to be started: ``target(name, *arguments, store=…)``."""

    def make(name: str, *arguments: object, store: Path = store) -> Target:
        folder = tmp_path / name / "stage"
        folder.mkdir(parents=True)
        command = (sys.executable, "-m", "tests.reliability.program", str(folder), str(store), *map(str, arguments))
        return Target(
            command, (Stage(folder),), tmp_path / f"{name}.log", EVERY * STEP_SECONDS, STEP_SECONDS, to_the_end=True
        )

    return make


@pytest.fixture(scope="session")
def whole(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stage's folder of a run without faults. Only for reading."""
    folder = tmp_path_factory.mktemp("whole") / "stage"
    command = (sys.executable, "-m", "tests.reliability.program", str(folder), str(store))
    run_without_faults(Target(command, (Stage(folder),), folder.parent / "output", to_the_end=True))
    return folder
