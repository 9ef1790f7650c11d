import contextlib
import fcntl
import importlib
import io
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from rsjax.runtime import HUGE_PAGES

ROOT = Path(__file__).parents[3]


def printed_by(module: str, *arguments: object) -> str:
    """Runs a command in this process, and returns what it prints."""
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        patch.setenv("GLIBC_TUNABLES", HUGE_PAGES)  # else the process would start over
        patch.setattr(sys, "argv", [module, *map(str, arguments)])
        importlib.import_module(module if module.startswith("experiments") else f"{module}.__main__").main()
    return printed.getvalue()


@dataclass(frozen=True)
class Commands:
    """Runs the project's commands as a user does, each in a process of its own.

    Attributes:
        data: the ``--data-dir`` of them all.
    """

    data: Path

    def __call__(self, module: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        line = [sys.executable, "-m", module, *map(str, arguments), "--data-dir", str(self.data)]
        environment = os.environ | {"JAX_PLATFORMS": "cpu"}
        return subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True)

    def train(self, run: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
        return self("experiments.train", "debug", "--run-dir", run, *arguments)

    def train_here(self, run: Path, *arguments: object) -> str:
        """Trains in this process, as :meth:`here` runs any command."""
        return self.here("experiments.train", "debug", "--run-dir", run, *arguments)

    def here(self, module: str, *arguments: object) -> str:
        """Runs a command in this process, since starting one takes seconds, and returns what it prints."""
        return printed_by(module, *arguments, "--data-dir", self.data)

    def refused(self, module: str, *arguments: object) -> str:
        """Returns the one line on standard error of a command that cannot be carried out, run in this process."""
        with contextlib.redirect_stderr(io.StringIO()) as errors, pytest.raises(SystemExit) as stop:
            self.here(module, *arguments)
        line = errors.getvalue()
        assert stop.value.code == 2, line
        assert line.startswith("error: ")
        assert line.count("\n") == 1, line
        return line


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory that all processes of this test session share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def command(shared: Path) -> Commands:
    return Commands(shared / "data")


@pytest.fixture(scope="session")
def debug(gl: str, shared: Path, command: Commands) -> Path:
    """The directory of one whole run of ``debug``; ``output`` in it is what the command printed. Only for reading."""
    run = shared / "debug"
    with (shared / "debug.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not run.exists():
            done = command.train(shared / "debug.tmp")
            assert done.returncode == 0, done.stderr
            (shared / "debug.tmp" / "output").write_text(done.stdout + done.stderr)
            (shared / "debug.tmp").rename(run)
    return run


@pytest.fixture
def run(debug: Path, tmp_path: Path) -> Path:
    """A copy of the whole run, to work on."""
    return shutil.copytree(debug, tmp_path / "run")
