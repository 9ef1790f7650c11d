"""Runs a job's units on workers that may die.

Only units without a mark are run, so a job that was killed goes on where it stopped. A unit that fails, or whose worker
dies twice, is quarantined; its episode's later units are not run; the others go on.
"""

import os
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import cv2

from rsjax.ingest.episode import EpisodeRef
from rsjax.ingest.jobs.work_items import Job, Mark, Unit, Work, fail_unit, run_unit

MAX_WAITING = 16  # episodes between two stages
MAX_DEATHS = 2  # of workers, by one unit; the second time it is the unit and not the machine


class WorkerDied(Exception):
    """The process that did a unit's work is gone; most often it was killed for lack of memory."""


class Outcome(NamedTuple):
    """What became of a unit that was submitted: its mark, or nothing where its worker died."""

    unit: Unit
    mark: Mark | None


class Executor(Protocol):
    """Workers. Messages to them are units: paths and ids, never pictures."""

    def accepts(self, stage: str) -> bool:
        """Whether a worker would begin with a unit of this stage at once, or nearly so."""
        ...

    def submit(self, unit: Unit) -> None:
        """Begins a unit's work."""
        ...

    def wait(self) -> list[Outcome]:
        """What became of some units; nothing, where only a worker has started. One that died is replaced.

        Raises:
            UserError: no unit could be worked on: a full disk, a missing package.
        """
        ...

    def close(self) -> None:
        """Stops the workers."""
        ...


@dataclass
class Inline:
    """The executor of one worker: this process."""

    job: Job
    _works: dict[str, Work] = field(default_factory=dict)
    _unit: Unit | None = None

    def accepts(self, stage: str) -> bool:
        return self._unit is None

    def submit(self, unit: Unit) -> None:
        self._unit = unit

    def wait(self) -> list[Outcome]:
        unit, self._unit = self._unit, None
        assert unit is not None
        return [Outcome(unit, run_unit(self.job, unit, opened(self.job, unit.stage, self._works)))]

    def close(self) -> None:
        self._works.clear()


@dataclass(frozen=True)
class Ran:
    """What one call of :func:`run` did; what was done before is not in it.

    Attributes:
        units: that were run, also those that failed.
        clips: records of the last stage.
        seconds: by the clock, on all workers together.
        clips_per_second: of that.
    """

    units: int
    clips: int
    seconds: float
    clips_per_second: float


def limit_threads(count: int) -> None:
    """In a worker, before a network is loaded: how many threads libraries may use beside each other's workers."""
    os.environ["OMP_NUM_THREADS"] = str(count)  # PyTorch
    cv2.setNumThreads(count)


def opened(job: Job, stage: str, works: dict[str, Work]) -> Work:
    """A stage's work, opened once per worker."""
    if stage not in works:
        works[stage] = job.stage(stage).open()
    return works[stage]


def run(job: Job, refs: Sequence[EpisodeRef], executor: Executor, report: Callable[[int, int], None]) -> Ran:
    """Runs all units that have no mark, later stages first, so that few episodes are under way at a time.

    Args:
        job: what is to be done.
        refs: the episodes, without duplicates.
        executor: the workers; closed by the caller.
        report: called with (units finished, units in all); those that are never run because an earlier one failed are
            finished too.

    Raises:
        UserError: as :meth:`Executor.wait`.
    """
    began = time.monotonic()
    driver = _Driver(job, executor, len(refs) * len(job.stages), report)
    driver.run(iter(refs))
    seconds = time.monotonic() - began
    return Ran(driver.ran, driver.clips, seconds, driver.clips / seconds)


class _Driver:
    """The state of :func:`run`."""

    def __init__(self, job: Job, executor: Executor, total: int, report: Callable[[int, int], None]) -> None:
        self._job, self._executor, self._total, self._report = job, executor, total, report
        self._names = [stage.name for stage in job.stages]
        self._ready: deque[Unit] = deque()
        self._flying = self._finished = self.ran = self.clips = 0
        self._deaths: Counter[str] = Counter()
        self._exhausted = False  # whether every episode was begun

    def run(self, refs: Iterator[EpisodeRef]) -> None:
        while True:
            self._fill(refs)
            if self._exhausted and not self._flying and not self._ready:
                return
            for outcome in self._executor.wait():
                self._settle(outcome)

    def _fill(self, refs: Iterator[EpisodeRef]) -> None:
        """Gives the workers what they accept; a new episode only where few wait in its middle."""
        self._submit_ready()
        while len(self._ready) < MAX_WAITING and self._executor.accepts(self._names[0]):
            ref = next(refs, None)
            if ref is None:
                self._exhausted = True
                return
            self._advance(ref, 0)
            self._submit_ready()

    def _submit_ready(self) -> None:
        for unit in sorted(self._ready, key=lambda unit: -self._names.index(unit.stage)):
            if self._executor.accepts(unit.stage):
                self._ready.remove(unit)
                self._executor.submit(unit)
                self._flying += 1

    def _advance(self, ref: EpisodeRef, first: int) -> None:
        """Makes the episode's first unfinished unit ready."""
        for number in range(first, len(self._names)):
            unit = Unit(ref, self._names[number])
            mark = self._job.mark(unit)
            if mark is None:
                self._ready.append(unit)
                return
            if mark["status"] == "failed":
                self._count(len(self._names) - number)
                return
            self._count(1)

    def _settle(self, outcome: Outcome) -> None:
        self._flying -= 1
        unit, mark = outcome
        number = self._names.index(unit.stage)
        if mark is None:
            path = str(self._job.output(unit))
            self._deaths[path] += 1
            if self._deaths[path] < MAX_DEATHS:
                self._ready.append(unit)
                return
            error = WorkerDied(f"{MAX_DEATHS} workers died over it, most likely for lack of memory; try fewer workers")
            mark = fail_unit(self._job, unit, error, {"seconds": 0.0, "cpu_seconds": 0.0})
        self.ran += 1
        if mark["status"] == "failed":
            self._count(len(self._names) - number)
            return
        self._count(1)
        if number + 1 == len(self._names):
            self.clips += mark["records"]
        self._advance(unit.ref, number + 1)

    def _count(self, units: int) -> None:
        self._finished += units
        self._report(self._finished, self._total)
