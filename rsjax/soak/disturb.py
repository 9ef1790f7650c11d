"""What is done to a training command: when, and how it has to take it."""

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

from rsjax.data.store import StoreError, open_store
from rsjax.soak.disk import small_disk
from rsjax.soak.watch import Attempt, checkpoints, unfinished

REQUEUE = os.EX_TEMPFAIL  # how a command that SIGTERM stopped says "start me again"
FAILED = 2  # and one that hit something that its user can cure
PATIENCE = 120.0  # seconds that saving and leaving may take

KILL_STARTING = "SIGKILL at the start"
KILL_COMPILING = "SIGKILL while compiling"
KILL_TRAINING = "SIGKILL in training"
KILL_WRITING = "SIGKILL writing a checkpoint"
KILL_BETWEEN = "SIGKILL in another stage"
TERMINATE = "SIGTERM"
DAMAGE = "newest checkpoint damaged"
FULL_DISK = "full disk"

# Each kind, and how many of it are in a deck.
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
class Blow:
    """One disturbance as it happened.

    Attributes:
        kind: what was hit, which is not always what was aimed at; a name of this module.
        detail: what exactly was done.
        problem: how the command failed to take it at once; empty where it did not.
    """

    kind: str
    detail: str = ""
    problem: str = ""


def deck(rng: random.Random, shares: dict[str, int]) -> Iterator[str]:
    """Kinds without end, shuffled deck after deck, so that each has its share also of a short soak."""
    while True:
        cards = [kind for kind, share in shares.items() for _ in range(share)]
        rng.shuffle(cards)
        yield from cards


def surroundings(kind: str, folder: Path, rng: random.Random) -> AbstractContextManager[None]:
    """What a start is run in so that this kind can happen: less room than a checkpoint needs, or nothing special."""
    steps = checkpoints(folder)
    if kind != FULL_DISK or not steps:
        return nullcontext()
    size = sum(p.stat().st_size for p in (folder / "checkpoints" / str(steps[-1])).rglob("*") if p.is_file())
    return small_disk(folder, int(rng.uniform(0.05, 0.9) * size))


def strike(kind: str, attempt: Attempt, rng: random.Random, interval: float) -> Blow | None:
    """Waits for a moment for this kind, and does it.

    Args:
        interval: seconds from one checkpoint to the next.

    Returns:
        What happened; None where the command or its stages ended first.
    """
    return _STRIKES[kind](attempt, rng, interval)


def _kill_starting(attempt: Attempt, rng: random.Random, interval: float) -> Blow | None:
    return _kill(attempt) if attempt.linger(rng.uniform(0.05, 3.0)) else None


def _kill_compiling(attempt: Attempt, rng: random.Random, interval: float) -> Blow | None:
    if not attempt.wait(lambda: attempt.phase() != "starting"):
        return None
    # How long it compiles is not known: from a tenth of a second to 20 seconds, or until it trains.
    attempt.wait(lambda: attempt.phase() == "training", 10 ** rng.uniform(-1.0, 1.3))
    return _kill(attempt) if attempt.linger(0.0) else None


def _kill_training(attempt: Attempt, rng: random.Random, interval: float) -> Blow | None:
    return _kill(attempt) if _in_training(attempt, rng, interval) else None


def _kill_writing(attempt: Attempt, rng: random.Random, interval: float) -> Blow | None:
    # Not always the first one of a start.
    if not attempt.wait(lambda: attempt.phase() == "training") or not attempt.linger(rng.uniform(0.0, interval)):
        return None
    if not attempt.wait(lambda: unfinished(attempt.folder)) or not attempt.linger(10 ** rng.uniform(-3.5, -0.7)):
        return None
    return _kill(attempt)


def _kill(attempt: Attempt) -> Blow:
    """The kill is counted as what it hit: a checkpoint that is only half there, or the phase."""
    kinds = {"starting": KILL_STARTING, "compiling": KILL_COMPILING, "training": KILL_TRAINING}
    folder, phase = attempt.folder, attempt.phase()
    attempt.kill()
    return Blow(KILL_WRITING if phase == "training" and unfinished(folder) else kinds[phase])


def _terminate(attempt: Attempt, rng: random.Random, interval: float) -> Blow | None:
    if rng.random() < 0.25:
        if not attempt.wait(lambda: attempt.phase() != "starting") or not attempt.linger(rng.uniform(0.0, 3.0)):
            return None
    elif not _in_training(attempt, rng, interval):
        return None
    attempt.process.send_signal(signal.SIGTERM)
    ended = _ends(attempt)
    status = attempt.process.returncode
    if status == 0:
        return None  # it was just finishing
    problem = "" if ended and status == REQUEUE else f"exit status {status if ended else 'never came'}, not {REQUEUE}"
    return Blow(TERMINATE, problem=problem)


def _damage(attempt: Attempt, rng: random.Random, interval: float) -> Blow | None:
    folder = attempt.folder
    if not attempt.wait(lambda: attempt.phase() == "training"):
        return None
    if not attempt.wait(lambda: _has_spare(attempt, folder)):
        return None
    if not attempt.linger(rng.uniform(0.0, interval)):
        return None
    attempt.kill()
    newest = folder / "checkpoints" / str(checkpoints(folder)[-1])
    return Blow(DAMAGE, damage_file(newest, rng))


def _has_spare(attempt: Attempt, folder: Path) -> bool:
    """Whether the newest checkpoint but one is known as sound: it was restored from, or written after that."""
    steps, resumed = checkpoints(folder), attempt.resumed.get(folder, 0)
    return len(steps) > 1 and steps[-1] > resumed and steps[-2] >= resumed


def _fill_disk(attempt: Attempt, rng: random.Random, interval: float) -> Blow | None:
    if not attempt.folder.is_mount():
        return _kill_training(attempt, rng, interval)
    while attempt.linger(0.1):
        pass
    status = attempt.process.poll()
    if status is None or status == 0:
        return None
    return Blow(FULL_DISK, problem="" if status == FAILED else f"exit status {status}, not {FAILED}")


_STRIKES: dict[str, Callable[[Attempt, random.Random, float], Blow | None]] = {
    KILL_STARTING: _kill_starting,
    KILL_COMPILING: _kill_compiling,
    KILL_TRAINING: _kill_training,
    KILL_WRITING: _kill_writing,
    TERMINATE: _terminate,
    DAMAGE: _damage,
    FULL_DISK: _fill_disk,
}


def _in_training(attempt: Attempt, rng: random.Random, interval: float) -> bool:
    # So long that most starts get past a checkpoint, and the run gets on.
    return attempt.wait(lambda: attempt.phase() == "training") and attempt.linger(rng.uniform(0.0, 2.5 * interval))


def _ends(attempt: Attempt) -> bool:
    try:
        attempt.process.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        attempt.process.send_signal(signal.SIGUSR1)  # what it hangs in goes to its output
        time.sleep(1.0)
        attempt.kill()
        return False
    return True


def damage_file(directory: Path, rng: random.Random) -> str:
    """Flips a byte of one of the directory's files, or cuts it off, or deletes it; says which."""
    path = rng.choice(sorted(p for p in directory.rglob("*") if p.is_file()))
    content, way = bytearray(path.read_bytes()), rng.choice(("flipped", "truncated", "deleted"))
    if way == "deleted" or not content:
        path.unlink()
        return f"{path.relative_to(directory)} deleted"
    place = rng.randrange(len(content))
    if way == "flipped":
        content[place] ^= rng.randrange(1, 256)
        path.write_bytes(content)
        return f"byte {place} of {path.relative_to(directory)} changed"
    os.truncate(path, place)
    return f"{path.relative_to(directory)} cut off after {place} bytes"


def damage_record(store: Path, rng: random.Random) -> int:
    """Changes a byte of a store so that exactly one record of its training split cannot be read; gives its number."""
    shard = sorted(store.glob("train-*.array_record"))[-1]
    sound = shard.read_bytes()
    places = [place for place, byte in enumerate(sound) if byte]  # most of a small shard is padding
    rng.shuffle(places)
    for place in places:
        content = bytearray(sound)
        content[place] ^= 255
        shard.unlink()  # it may be a link to the sound one
        shard.write_bytes(content)
        if len(unreadable := _unreadable(store)) == 1:
            return unreadable[0]
    raise AssertionError(f"{shard}: no byte of it belongs to one record alone")


def _unreadable(store: Path) -> list[int]:
    source, numbers = open_store(store).source("train"), []
    for number in range(len(source)):
        try:
            source[number]
        except StoreError:
            numbers.append(number)
    return numbers


def copy_tree(source: Path, place: Path) -> None:
    """A copy whose files are links where the file system allows it: only for what is replaced, never written into."""

    def link(one: str, other: str) -> None:
        try:
            os.link(one, other)
        except OSError:
            shutil.copy2(one, other)

    shutil.copytree(source, place, copy_function=link)
