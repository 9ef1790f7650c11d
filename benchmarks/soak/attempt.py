"""Starts a training command in a process of its own and follows its progress from outside, by the run's directory.

The command does not know that it is watched, so faults hit exactly what a user runs.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from rsjax.training.checkpoint import UNFINISHED

POLL_SECONDS = 0.002  # a small model's checkpoint is written in 50 ms

Phase = Literal["starting", "compiling", "training"]


def checkpoints(folder: Path) -> list[int]:
    """Returns the steps of a stage's complete checkpoints."""
    return sorted(int(name) for name in _names(folder / "checkpoints") if name.isdigit())


def unfinished(folder: Path) -> bool:
    """Whether a checkpoint is being written, or was when its writer died."""
    return any(UNFINISHED in name for name in _names(folder / "checkpoints"))


def finished(folder: Path) -> bool:
    """Whether the stage is marked as finished."""
    try:
        return bool(json.loads((folder / "made.json").read_text())["finished"])
    except (OSError, ValueError, KeyError):
        return False


def last_logged(folder: Path) -> int:
    """Returns the last step in the stage's log, 0 without one; a line that is still being written does not count."""
    try:
        with (folder / "log.jsonl").open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 16384))
            lines = file.read().split(b"\n")[:-1]
    except OSError:
        return 0
    for line in reversed(lines):
        with contextlib.suppress(ValueError, KeyError):
            return int(json.loads(line)["step"])
    return 0


def last_step(folder: Path) -> int:
    """Returns the last step that is known to be done: logged or saved."""
    return max(last_logged(folder), *checkpoints(folder), 0)


class Before(NamedTuple):
    """State of a stage's directory before a start."""

    mark: int  # modification time
    log: int  # inode
    checkpoints: tuple[int, ...]

    @classmethod
    def read(cls, folder: Path) -> "Before":
        return cls(_mark_time(folder), _log_inode(folder), tuple(checkpoints(folder)))


class Attempt:
    """One start of the command.

    Args:
        command: the command line.
        folders: of the training stages, in the order in which they run.
        output: a file to which everything that the command prints is appended.

    Attributes:
        process: the command's.
        resumed: the step from which each stage resumed, once its loop has begun.
        first_step: seconds from the start to the first new step; None before it.
    """

    def __init__(self, command: Sequence[str], folders: Sequence[Path], output: Path) -> None:
        self._folders = tuple(folders)
        self._before = {folder: Before.read(folder) for folder in folders}
        self._training: set[Path] = set()
        self._began = time.monotonic()
        self.resumed: dict[Path, int] = {}
        self.first_step: float | None = None
        # A soak that is killed leaves no training behind, where util-linux is installed.
        setpriv = shutil.which("setpriv")
        dying_with_parent = (setpriv, "--pdeathsig", "KILL") if setpriv else ()
        with output.open("ab") as out:
            self.process = subprocess.Popen(
                (*dying_with_parent, *command),
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                start_new_session=True,
            )

    @property
    def folder(self) -> Path:
        """The stage that trains now or next; the last one when all are finished."""
        return next((folder for folder in self._folders if not finished(folder)), self._folders[-1])

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.monotonic() - self._began

    def phase(self) -> Phase:
        """Returns how far this start is: stage not begun, before the stage's first new step, or past it."""
        folder = self.folder
        if folder in self._training:
            return "training"
        before = self._before[folder]
        if _mark_time(folder) == before.mark:
            return "starting"
        if folder not in self.resumed:
            if _log_inode(folder) in (0, before.log):
                return "compiling"
            # The loop truncates its log first; by then it has renamed a damaged checkpoint.
            self.resumed[folder] = max({*before.checkpoints}.intersection(checkpoints(folder)), default=0)
        if last_step(folder) <= self.resumed[folder]:
            return "compiling"
        if self.first_step is None:
            self.first_step = self.seconds
        self._training.add(folder)
        return "training"

    def wait(self, until: Callable[[], bool], seconds: float = float("inf")) -> bool:
        """Waits for a condition; returns whether it came true within the time and before command or stages ended."""
        end = time.monotonic() + seconds
        while self.alive and not all(finished(folder) for folder in self._folders):
            self.phase()  # records ``resumed`` and ``first_step`` on the way
            if until():
                return True
            if time.monotonic() >= end:
                return False
            time.sleep(POLL_SECONDS)
        return False

    def wait_for_training(self, seconds: float = float("inf")) -> bool:
        """Waits for the first new step of the stage; returns as :meth:`wait`."""
        return self.wait(lambda: self.phase() == "training", seconds)

    def linger(self, seconds: float = float("inf")) -> bool:
        """Waits so long; returns whether command and stages were still going on at the end of it."""
        end = time.monotonic() + seconds
        return self.wait(lambda: time.monotonic() >= end)

    def kill(self) -> None:
        """Sends SIGKILL to the command and everything that it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


def _mark_time(folder: Path) -> int:
    try:
        return (folder / "made.json").stat().st_mtime_ns
    except OSError:
        return 0


def _log_inode(folder: Path) -> int:
    try:
        return (folder / "log.jsonl").stat().st_ino
    except OSError:
        return 0


def _names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:
        return []
