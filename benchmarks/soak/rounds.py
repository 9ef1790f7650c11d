"""One round: a run from beginning to end, hit by faults on the way and started again after each."""

import math
import random
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.soak.attempt import Attempt, finished, last_step
from benchmarks.soak.faults import KILL_BETWEEN, Fault, conditions, inject
from rsjax.errors import UserError
from rsjax.progress import duration

MAX_KILLS = 2  # of a stage without checkpoints; after these it is left alone


class SoakError(UserError):
    """A soak with these options is impossible, or a run without faults failed."""


@dataclass(frozen=True)
class Stage:
    """A stage of the command: its directory, whether it trains, and the seconds that it takes without faults."""

    folder: Path
    trained: bool = True
    seconds: float = 0.0


@dataclass(frozen=True)
class Target:
    """The command that faults are injected into.

    Attributes:
        command: starts the run, and resumes it.
        stages: those that are hit, in order.
        output: a file for everything that the command prints.
        interval: seconds between checkpoints.
        step_seconds: seconds per step.
        to_the_end: the command has to exit by itself; False: it is killed once the stages are finished.
    """

    command: tuple[str, ...]
    stages: tuple[Stage, ...]
    output: Path
    interval: float = 0.0
    step_seconds: float = 0.0
    to_the_end: bool = False

    @property
    def trained(self) -> tuple[Path, ...]:
        return tuple(stage.folder for stage in self.stages if stage.trained)

    @property
    def current(self) -> Stage | None:
        """The first unfinished stage."""
        return next((stage for stage in self.stages if not finished(stage.folder)), None)

    def problem(self, attempt: Attempt) -> str:
        """Returns how a start without a fault failed; empty if it did not."""
        if attempt.process.returncode == 0 if self.to_the_end else self.current is None:
            return ""
        lines = [line for line in self.output.read_text(errors="replace").splitlines() if line.strip()]
        return f"exit status {attempt.process.returncode}: {lines[-1].strip() if lines else 'nothing printed'}"


@dataclass
class Event:
    """A fault and its consequences.

    Attributes:
        folder: of the stage that was hit.
        step: the last one known to be done at that moment.
        survived: whether the run went on to a new step, or to its end.
        repeated: steps that were done a second time; None until the next start's loop has begun.
        seconds: from the next start to its first new step, or to its own end.
    """

    fault: Fault
    folder: Path
    step: int
    survived: bool = False
    repeated: int | None = None
    seconds: float = 0.0

    def lost(self, step_seconds: float) -> float:
        """Returns the seconds that the fault cost: the next start, and the repeated steps."""
        return self.seconds + (self.repeated or 0) * step_seconds


@dataclass(frozen=True)
class Round:
    """A round's events in order; ``problem`` says how the command failed for good, and is empty if it did not."""

    events: tuple[Event, ...]
    starts: int
    seconds: float
    problem: str = ""


def run_round(
    target: Target,
    kinds: Iterable[str],
    rng: random.Random,
    until: float = math.inf,
    show: Callable[[str], None] = print,
) -> Round:
    """Injects faults into a run until a moment, and then lets it finish.

    Args:
        kinds: of the faults; when they are used up, the run is left alone.
        until: in seconds of the monotonic clock.
        show: prints a line.
    """
    events: list[Event] = []
    began = time.monotonic()
    starts = 0
    kinds = iter(kinds)
    while True:
        kind = next(kinds, None) if time.monotonic() < until else None
        starts += 1
        attempt, event = _start(target, kind, events, rng)
        problem = target.problem(attempt) if event is None else event.fault.problem
        settle(events, attempt, done=event is None and not problem)
        if events and attempt.first_step is not None:
            show(f"  went on from step {max(attempt.resumed.values())} after {duration(attempt.first_step)}")
        if event is not None:
            events.append(event)
            fault = event.fault
            show(f"{event.folder.name} at step {event.step}: {': '.join(filter(None, (fault.kind, fault.detail)))}")
        if event is None or problem:
            return Round(tuple(events), starts, time.monotonic() - began, problem)


def run_without_faults(target: Target) -> None:
    """Runs a command until its stages are finished.

    Raises:
        SoakError: it ended before.
    """
    if problem := run_round(target, (), random.Random()).problem:
        raise SoakError(f"a run without faults failed: {problem}; see {target.output}")


def _start(
    target: Target, kind: str | None, events: Sequence[Event], rng: random.Random
) -> tuple[Attempt, Event | None]:
    """Starts the command once; returns the event that ended it too, None if nothing was injected."""
    stage = target.current or target.stages[-1]
    between = kind is not None and not stage.trained and sum(e.folder == stage.folder for e in events) < MAX_KILLS
    with conditions(kind or "", stage.folder, rng):
        attempt = Attempt(target.command, target.trained, target.output)
        try:
            folder = stage.folder
            fault = _kill_between(stage, attempt, rng) if between else None
            if fault is None and kind is not None:
                fault = inject(kind, attempt, rng, target.interval)
                folder = attempt.folder
            if fault is None:
                attempt.linger()
                if target.to_the_end:
                    attempt.process.wait()
        finally:
            attempt.kill()
    return attempt, None if fault is None else Event(fault, folder, last_step(folder))


def _kill_between(stage: Stage, attempt: Attempt, rng: random.Random) -> Fault | None:
    moment = rng.uniform(0.0, stage.seconds + 3.0)  # Python takes some seconds to start
    while attempt.seconds < moment and attempt.alive and not finished(stage.folder):
        time.sleep(0.01)
    if finished(stage.folder) or not attempt.alive:
        return None
    attempt.kill()
    return Fault(KILL_BETWEEN, stage.folder.name)


def settle(events: Sequence[Event], attempt: Attempt, done: bool) -> None:
    """Completes earlier events with what a start shows of their consequences.

    The last event is charged with the time that starting took, the first event of a stage that is still open with the
    repeated steps: starts in between did none.

    Args:
        done: whether the start finished all stages.
    """
    if events:
        events[-1].seconds = attempt.first_step or attempt.seconds
    for folder, resumed in attempt.resumed.items():
        still_open = [event for event in events if event.folder == folder and event.repeated is None]
        for index, event in enumerate(still_open):
            event.repeated = 0 if index else max(0, event.step - resumed)
    if done or attempt.first_step is not None:
        for event in events:
            event.survived |= not event.fault.problem
