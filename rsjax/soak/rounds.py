"""One round: a run from its beginning to its end, disturbed on the way and started again each time."""

import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rsjax.progress import duration
from rsjax.soak.disturb import KILL_BETWEEN, Blow, strike, surroundings
from rsjax.soak.watch import Attempt, checkpoints, finished, last_logged

HITS = 2  # kills that a stage without checkpoints takes; then it is let through


@dataclass(frozen=True)
class Stage:
    """A stage of the command: where its mark lies, whether it trains, and how long it takes undisturbed."""

    folder: Path
    trained: bool = True
    seconds: float = 0.0


@dataclass(frozen=True)
class Target:
    """What is disturbed.

    Attributes:
        command: starts the run, and starts it again.
        stages: those that are disturbed, in their order.
        output: a file for all that the command prints.
        interval: seconds between checkpoints.
        step_seconds: of a step.
        to_the_end: the command has to end by itself; False: it is stopped once the stages are finished.
    """

    command: tuple[str, ...]
    stages: tuple[Stage, ...]
    output: Path
    interval: float
    step_seconds: float
    to_the_end: bool = False

    @property
    def trained(self) -> tuple[Path, ...]:
        return tuple(stage.folder for stage in self.stages if stage.trained)

    @property
    def current(self) -> Stage | None:
        """The first stage that is not finished."""
        return next((stage for stage in self.stages if not finished(stage.folder)), None)

    def problem(self, attempt: Attempt) -> str:
        """How a start that nothing disturbed failed; empty where it did not."""
        done = attempt.process.returncode == 0 if self.to_the_end else self.current is None
        if done:
            return ""
        lines = [line for line in self.output.read_text(errors="replace").splitlines() if line.strip()]
        return f"exit status {attempt.process.returncode}: {lines[-1].strip() if lines else 'nothing printed'}"


@dataclass(frozen=True)
class Event:
    """A disturbance and what became of it.

    Attributes:
        folder: of the stage that was hit.
        step: the last one known to be done when it came.
        survived: whether the run went on to a new step, or to its end.
        repeated: steps done a second time; None until the next start's loop has begun.
        seconds: from the next start to its first new step, or to its own end.
    """

    blow: Blow
    folder: Path
    step: int
    survived: bool = False
    repeated: int | None = None
    seconds: float = 0.0

    def lost(self, step_seconds: float) -> float:
        """Seconds that the disturbance cost: starting again, and steps done again."""
        return self.seconds + (self.repeated or 0) * step_seconds


@dataclass(frozen=True)
class Round:
    """A round's events, in order; ``problem`` says how the command failed for good, or is empty."""

    events: tuple[Event, ...]
    starts: int
    seconds: float
    problem: str = ""


def run_round(
    target: Target, kinds: Iterator[str], rng: random.Random, until: float, say: Callable[[str], None]
) -> Round:
    """Disturbs a run until a moment, and leaves it to finish.

    Args:
        kinds: of disturbances; when there are no more, the run is left alone.
        until: in seconds of the monotonic clock.
        say: shows a line.
    """
    events: list[Event] = []
    began, starts = time.monotonic(), 0
    while True:
        kind = next(kinds, None) if time.monotonic() < until else None
        starts += 1
        attempt, event = _start(target, kind, events, rng)
        problem = target.problem(attempt) if event is None else event.blow.problem
        events = settle(events, attempt, done=event is None and not problem)
        if events and attempt.first_step is not None:
            say(f"  went on from step {max(attempt.resumed.values())} after {duration(attempt.first_step)}")
        if event is not None:
            events.append(event)
            told = f"{event.blow.kind}: {event.blow.detail}" if event.blow.detail else event.blow.kind
            say(f"{event.folder.name} at step {event.step}: {told}")
        if event is None or problem:
            return Round(tuple(events), starts, time.monotonic() - began, problem)


def _start(
    target: Target, kind: str | None, events: Sequence[Event], rng: random.Random
) -> tuple[Attempt, Event | None]:
    """Starts the command once; the event that ended it, None where it was left to go on as far as it could."""
    stage = target.current or target.stages[-1]
    between = kind is not None and not stage.trained and sum(e.folder == stage.folder for e in events) < HITS
    with surroundings(kind or "", stage.folder, rng):
        attempt = Attempt(target.command, target.trained, target.output)
        try:
            blow = _kill_between(stage, attempt, rng) if between else None
            folder = stage.folder if blow else attempt.folder
            if blow is None and kind is not None:
                blow = strike(kind, attempt, rng, target.interval)
                folder = attempt.folder
            if blow is None:
                attempt.linger(float("inf"))
                if target.to_the_end:
                    attempt.process.wait()
        finally:
            attempt.kill()
    return attempt, None if blow is None else Event(blow, folder, max(last_logged(folder), *checkpoints(folder), 0))


def _kill_between(stage: Stage, attempt: Attempt, rng: random.Random) -> Blow | None:
    moment = rng.uniform(0.0, stage.seconds + 3.0)  # and what Python needs to start
    while attempt.seconds < moment and attempt.alive and not finished(stage.folder):
        time.sleep(0.01)
    if finished(stage.folder) or not attempt.alive:
        return None
    attempt.kill()
    return Blow(KILL_BETWEEN, stage.folder.name)


def settle(events: Sequence[Event], attempt: Attempt, done: bool) -> list[Event]:
    """The events before a start, with what it tells of them.

    The last one is charged with what starting took, the first of those that are still open with the steps that are done
    again: starts in between made none.

    Args:
        done: whether the start came to the end of what is disturbed.
    """
    settled = list(events)
    if settled:
        settled[-1] = replace(settled[-1], seconds=attempt.first_step or attempt.seconds)
    for folder, resumed in attempt.resumed.items():
        still_open = [n for n, event in enumerate(settled) if event.folder == folder and event.repeated is None]
        for place, number in enumerate(still_open):
            repeated = 0 if place else max(0, settled[number].step - resumed)
            settled[number] = replace(settled[number], repeated=repeated)
    went_on = done or attempt.first_step is not None
    return [replace(event, survived=True) if went_on and not event.blow.problem else event for event in settled]
