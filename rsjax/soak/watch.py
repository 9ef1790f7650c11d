"""A command that trains, started in a process of its own and looked at from outside: its directory tells how far it is.

Nothing in the command knows that it is watched, so what is disturbed is what a user runs.
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
    """Steps of a stage's checkpoints that stand under their own names, so are whole."""
    return sorted(int(name) for name in _names(folder / "checkpoints") if name.isdigit())


def unfinished(folder: Path) -> bool:
    """Whether a checkpoint is being written, or was when its writer died."""
    return any(UNFINISHED in name for name in _names(folder / "checkpoints"))


def finished(folder: Path) -> bool:
    """Whether the stage's mark says so."""
    try:
        return bool(json.loads((folder / "stage.json").read_text())["finished"])
    except (OSError, ValueError, KeyError):
        return False


def last_logged(folder: Path) -> int:
    """The last step in the stage's log; 0 where there is none. A line that is still being written does not count."""
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


class Seen(NamedTuple):
    """What lay in a stage's directory before a start."""

    mark: int
    log: int
    checkpoints: tuple[int, ...]

    @classmethod
    def of(cls, folder: Path) -> "Seen":
        return cls(_stat(folder / "stage.json").mtime, _stat(folder / "log.jsonl").inode, tuple(checkpoints(folder)))


class Attempt:
    """One start of the command.

    Args:
        command: as it is typed.
        folders: of the training stages, in the order in which they run.
        output: a file that all it prints is added to.

    Attributes:
        process: the command's.
        began: when it was started, in seconds of the monotonic clock.
        resumed: the step each stage went on from, once its loop has begun.
        first_step: seconds from the start until the first new step was seen; None before.
    """

    def __init__(self, command: Sequence[str], folders: Sequence[Path], output: Path) -> None:
        self._folders = tuple(folders)
        self._before = {folder: Seen.of(folder) for folder in folders}
        self.resumed: dict[Path, int] = {}
        self.first_step: float | None = None
        self._training: set[Path] = set()
        self.began = time.monotonic()
        with output.open("ab") as out:
            self.process = subprocess.Popen(
                (*_dying_with_parent(), *command),
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                start_new_session=True,
            )

    @property
    def folder(self) -> Path:
        """The stage that is trained now, or will be next; the last one when all are finished."""
        return next((folder for folder in self._folders if not finished(folder)), self._folders[-1])

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.began

    def phase(self) -> Phase:
        """How far this start has come: nothing begun, on the way to the first step of the stage, or past it."""
        folder = self.folder
        if folder in self._training:
            return "training"
        before = self._before[folder]
        if _stat(folder / "stage.json").mtime == before.mark:
            return "starting"
        if folder not in self.resumed:
            if _stat(folder / "log.jsonl").inode in (0, before.log):
                return "compiling"
            # The loop cuts its log first; by then a damaged checkpoint has been put aside.
            left = set(before.checkpoints).intersection(checkpoints(folder))
            self.resumed[folder] = max(left, default=0)
        if max(last_logged(folder), *checkpoints(folder), 0) <= self.resumed[folder]:
            return "compiling"
        if self.first_step is None:
            self.first_step = self.seconds
        self._training.add(folder)
        return "training"

    def wait(self, until: Callable[[], bool], seconds: float = float("inf")) -> bool:
        """Waits for a condition, for at most so many seconds; whether it came before the command or the stages ended.

        The phase is kept up to date on the way.
        """
        end = time.monotonic() + seconds
        while self.alive and not all(finished(folder) for folder in self._folders):
            self.phase()
            if until():
                return True
            if time.monotonic() >= end:
                return False
            time.sleep(POLL_SECONDS)
        return False

    def linger(self, seconds: float) -> bool:
        """Waits so long; whether the command and the stages still went on at the end of it."""
        end = time.monotonic() + seconds
        return self.wait(lambda: time.monotonic() >= end)

    def kill(self) -> None:
        """SIGKILL to the command and all that it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


def _dying_with_parent() -> tuple[str, ...]:
    # A soak that is killed leaves no training behind, where util-linux is installed.
    setpriv = shutil.which("setpriv")
    return (setpriv, "--pdeathsig", "KILL") if setpriv else ()


class _Stat(NamedTuple):
    mtime: int
    inode: int


def _stat(path: Path) -> _Stat:
    try:
        found = path.stat()
    except OSError:
        return _Stat(0, 0)
    return _Stat(found.st_mtime_ns, found.st_ino)


def _names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:
        return []
