"""The faults that are injected into a training command: when each comes, and how the command has to react."""

import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from benchmarks.soak.attempt import Attempt, checkpoints, unfinished
from benchmarks.soak.disk import small_disk
from rsjax.data.store import StoreError, open_store

REQUEUE = os.EX_TEMPFAIL  # the exit status after SIGTERM: start me again
FAILED = 2  # the exit status after an error that the user can cure
PATIENCE = 120.0  # seconds that the command may take to save and exit
DUMP_EVERY = 30.0  # seconds without an answer, at which the command prints what each of its threads is doing

KILL_STARTING = "SIGKILL at the start"
KILL_COMPILING = "SIGKILL while compiling"
KILL_TRAINING = "SIGKILL in training"
KILL_WRITING = "SIGKILL writing a checkpoint"
KILL_BETWEEN = "SIGKILL in another stage"
TERMINATE = "SIGTERM"
DAMAGE = "newest checkpoint damaged"
FULL_DISK = "full disk"

# How often each kind comes in one pass of the schedule.
SHARES = {
    KILL_STARTING: 1,
    KILL_COMPILING: 1,
    KILL_TRAINING: 2,
    KILL_WRITING: 2,
    TERMINATE: 2,
    DAMAGE: 2,
    FULL_DISK: 1,
}


@dataclass(frozen=True)
class Fault:
    """One fault as it happened.

    Attributes:
        kind: what was hit, which is not always what was aimed at; a name of this module.
        detail: what exactly was done.
        problem: the command's wrong reaction; empty if it reacted as it should.
    """

    kind: str
    detail: str = ""
    problem: str = ""


def schedule(rng: random.Random, shares: dict[str, int]) -> Iterator[str]:
    """Yields kinds of faults without end, in shuffled passes, so that a short soak has every kind's share too."""
    while True:
        kinds = [kind for kind, share in shares.items() for _ in range(share)]
        rng.shuffle(kinds)
        yield from kinds


def conditions(kind: str, folder: Path, rng: random.Random) -> AbstractContextManager[None]:
    """Returns the context a start needs for this kind of fault: for a full disk, less space than a checkpoint takes."""
    steps = checkpoints(folder)
    if kind != FULL_DISK or not steps:
        return nullcontext()
    size = sum(p.stat().st_size for p in (folder / "checkpoints" / str(steps[-1])).rglob("*") if p.is_file())
    return small_disk(folder, int(rng.uniform(0.05, 0.9) * size))


def inject(kind: str, attempt: Attempt, rng: random.Random, interval: float) -> Fault | None:
    """Waits for a random moment that suits this kind of fault, and injects it.

    Args:
        interval: seconds between two checkpoints.

    Returns:
        What happened; None if the command or its stages ended first.
    """
    return _INJECT[kind](attempt, rng, interval)


def _kill_starting(attempt: Attempt, rng: random.Random, interval: float) -> Fault | None:
    return _kill(attempt) if attempt.linger(rng.uniform(0.05, 3.0)) else None


def _kill_compiling(attempt: Attempt, rng: random.Random, interval: float) -> Fault | None:
    if not attempt.wait(lambda: attempt.phase() != "starting"):
        return None
    # How long compilation takes is unknown: wait from a tenth of a second to 20 seconds, or until training starts.
    attempt.wait_for_training(10 ** rng.uniform(-1.0, 1.3))
    return _kill(attempt) if attempt.linger(0.0) else None


def _kill_training(attempt: Attempt, rng: random.Random, interval: float) -> Fault | None:
    return _kill(attempt) if _wait_in_training(attempt, rng, interval) else None


def _kill_writing(attempt: Attempt, rng: random.Random, interval: float) -> Fault | None:
    # Lingering first, so that it is not always the first checkpoint of a start.
    waited = attempt.wait_for_training() and attempt.linger(rng.uniform(0.0, interval))
    if not waited or not attempt.wait(lambda: unfinished(attempt.folder)):
        return None
    return _kill(attempt) if attempt.linger(10 ** rng.uniform(-3.5, -0.7)) else None


def _kill(attempt: Attempt) -> Fault:
    """Kills, and counts the kill as what it hit: a checkpoint half written, or the phase."""
    kinds = {"starting": KILL_STARTING, "compiling": KILL_COMPILING, "training": KILL_TRAINING}
    folder = attempt.folder
    phase = attempt.phase()
    attempt.kill()
    return Fault(KILL_WRITING if phase == "training" and unfinished(folder) else kinds[phase])


def _terminate(attempt: Attempt, rng: random.Random, interval: float) -> Fault | None:
    if rng.random() < 0.25:
        waited = attempt.wait(lambda: attempt.phase() != "starting") and attempt.linger(rng.uniform(0.0, 3.0))
    else:
        waited = _wait_in_training(attempt, rng, interval)
    if not waited:
        return None
    attempt.process.send_signal(signal.SIGTERM)
    began = time.monotonic()
    status = None
    while status is None and time.monotonic() < began + PATIENCE:
        try:
            status = attempt.process.wait(DUMP_EVERY)
        except subprocess.TimeoutExpired:
            attempt.process.send_signal(signal.SIGUSR1)  # makes it print what each thread is doing
    took = f"{time.monotonic() - began:.1f} s"
    if status is None:
        time.sleep(1.0)
        attempt.kill()
        return Fault(TERMINATE, problem=f"no answer within {took}; the output has the stacks of its threads")
    if status == 0:
        return None  # it was about to finish
    problem = "" if status == REQUEUE else f"exit status {status}, not {REQUEUE}"
    return Fault(TERMINATE, f"answered after {took}", problem)


def _damage(attempt: Attempt, rng: random.Random, interval: float) -> Fault | None:
    folder = attempt.folder
    waited = attempt.wait_for_training() and attempt.wait(lambda: _has_spare(attempt, folder))
    if not waited or not attempt.linger(rng.uniform(0.0, interval)):
        return None
    attempt.kill()
    newest = folder / "checkpoints" / str(checkpoints(folder)[-1])
    return Fault(DAMAGE, damage_file(newest, rng))


def _has_spare(attempt: Attempt, folder: Path) -> bool:
    """Whether the last checkpoint but one is known to be sound: restored from, or written after the one that was."""
    steps = checkpoints(folder)
    resumed = attempt.resumed.get(folder, 0)
    return len(steps) > 1 and steps[-1] > resumed and steps[-2] >= resumed


def _fill_disk(attempt: Attempt, rng: random.Random, interval: float) -> Fault | None:
    if not attempt.folder.is_mount():
        return _kill_training(attempt, rng, interval)
    attempt.linger()
    status = attempt.process.poll()
    if status is None or status == 0:
        return None
    return Fault(FULL_DISK, problem="" if status == FAILED else f"exit status {status}, not {FAILED}")


_INJECT: dict[str, Callable[[Attempt, random.Random, float], Fault | None]] = {
    KILL_STARTING: _kill_starting,
    KILL_COMPILING: _kill_compiling,
    KILL_TRAINING: _kill_training,
    KILL_WRITING: _kill_writing,
    TERMINATE: _terminate,
    DAMAGE: _damage,
    FULL_DISK: _fill_disk,
}


def _wait_in_training(attempt: Attempt, rng: random.Random, interval: float) -> bool:
    # Long enough that most starts pass a checkpoint, so the run progresses.
    return attempt.wait_for_training() and attempt.linger(rng.uniform(0.0, 2.5 * interval))


def damage_file(directory: Path, rng: random.Random) -> str:
    """Changes a byte of one of the directory's files, or truncates or deletes the file; returns which."""
    path = rng.choice(sorted(p for p in directory.rglob("*") if p.is_file()))
    content = bytearray(path.read_bytes())
    way = rng.choice(("flipped", "truncated", "deleted"))
    if way == "deleted" or not content:
        path.unlink()
        return f"{path.relative_to(directory)} deleted"
    offset = rng.randrange(len(content))
    if way == "flipped":
        content[offset] ^= rng.randrange(1, 256)
        path.write_bytes(content)
        return f"byte {offset} of {path.relative_to(directory)} changed"
    os.truncate(path, offset)
    return f"{path.relative_to(directory)} truncated to {offset} bytes"


def damage_record(store: Path, rng: random.Random) -> int:
    """Changes a byte of a store so that exactly one training record becomes unreadable; returns its number."""
    shard = sorted(store.glob("train-*.array_record"))[-1]
    sound = shard.read_bytes()
    offsets = [offset for offset, byte in enumerate(sound) if byte]  # most of a small shard is padding
    rng.shuffle(offsets)
    for offset in offsets:
        content = bytearray(sound)
        content[offset] ^= 255
        shard.unlink()  # it may be a hard link to the sound one
        shard.write_bytes(content)
        if len(unreadable := _unreadable(store)) == 1:
            return unreadable[0]
    raise AssertionError(f"{shard}: no byte of it belongs to one record alone")


def _unreadable(store: Path) -> list[int]:
    source = open_store(store).source("train")
    numbers = []
    for number in range(len(source)):
        try:
            source[number]
        except StoreError:
            numbers.append(number)
    return numbers


def copy_tree(source: Path, destination: Path) -> None:
    """Copies a directory, with hard links where the file system allows: for files that are replaced, never edited."""

    def link(one: str, other: str) -> None:
        try:
            os.link(one, other)
        except OSError:
            shutil.copy2(one, other)

    shutil.copytree(source, destination, copy_function=link)
