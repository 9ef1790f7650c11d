"""Runs a job's units on workers that may die, and counts what came of every episode.

Only units without a mark are run, so a job that was killed goes on where it stopped. A unit that fails, or whose worker
dies twice, is quarantined; its episode's later units are not run; the others go on.
"""

import dataclasses
import json
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from rsjax.annotate.units import Job, Mark, Unit, Work, fail_unit, run_unit
from rsjax.data.episode import EpisodeRef
from rsjax.data.store import disk_guard, write_atomically
from rsjax.errors import UserError

QUARANTINE = "quarantine.jsonl"
SUMMARY = "summary.json"
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
        """At least one outcome; a worker that died is replaced.

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


def opened(job: Job, stage: str, works: dict[str, Work]) -> Work:
    """A stage's work, opened once per worker."""
    if stage not in works:
        works[stage] = job.stage(stage).open()
    return works[stage]


def run(job: Job, refs: Sequence[EpisodeRef], executor: Executor, report: Callable[[int, int], None]) -> int:
    """Runs all units that have no mark, later stages first, so that few episodes are under way at a time.

    Args:
        job: what is to be done.
        refs: the episodes, without duplicates.
        executor: the workers; closed by the caller.
        report: called with (units finished, units in all); those that are never run because an earlier one failed are
            finished too.

    Returns:
        How many units were run.

    Raises:
        UserError: as :meth:`Executor.wait`.
    """
    driver = _Driver(job, executor, len(refs) * len(job.stages), report)
    driver.run(iter(refs))
    return driver.ran


class _Driver:
    """The state of :func:`run`."""

    def __init__(self, job: Job, executor: Executor, total: int, report: Callable[[int, int], None]) -> None:
        self._job, self._executor, self._total, self._report = job, executor, total, report
        self._names = [stage.name for stage in job.stages]
        self._ready: deque[Unit] = deque()
        self._flying = self._finished = self.ran = 0
        self._deaths: Counter[str] = Counter()

    def run(self, refs: Iterator[EpisodeRef]) -> None:
        while True:
            self._fill(refs)
            if not self._flying:
                return
            for outcome in self._executor.wait():
                self._settle(outcome)

    def _fill(self, refs: Iterator[EpisodeRef]) -> None:
        """Gives the workers what they accept; a new episode only where few wait in its middle."""
        self._submit_ready()
        while len(self._ready) < MAX_WAITING and self._executor.accepts(self._names[0]):
            ref = next(refs, None)
            if ref is None:
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
        self._advance(unit.ref, number + 1)

    def _count(self, units: int) -> None:
        self._finished += units
        self._report(self._finished, self._total)


@dataclass(frozen=True)
class Counts:
    """What became of every episode: found = done + filtered + quarantined; and of windows.

    Attributes:
        found: episodes that the source lists.
        done: those that gave a clip.
        filtered: reason by episode, for those that were read and gave none.
        quarantined: rows of the quarantine table: ``episode``, ``stage``, ``key``, ``error``, ``traceback``.
        windows: how many were ``kept``, and how many each reason left out.
        stages: of each, how many units are done and failed, the seconds that they took on a worker and on its cores,
            and the clips per second of such a worker.
    """

    found: int
    done: int
    filtered: dict[str, str]
    quarantined: list[dict[str, Any]]
    windows: dict[str, int]
    stages: dict[str, dict[str, Any]]


def count(job: Job, refs: Sequence[EpisodeRef], refused: Sequence[tuple[EpisodeRef, str]] = ()) -> Counts:
    """Counts by the marks of a job that was run to its end; its last stage makes the clips.

    Args:
        refused: further episodes that are not in the result, and why.

    Raises:
        UserError: a unit has no mark.
    """
    filtered: dict[str, str] = {}
    quarantined = [dict(zip(_ROW, (ref.id, "list", ref.fingerprint, why, ""), strict=True)) for ref, why in refused]
    windows = Counter({"kept": 0})
    zeros = {"done": 0, "failed": 0, "seconds": 0.0, "cpu_seconds": 0.0}
    stages: dict[str, dict[str, Any]] = {stage.name: dict(zeros) for stage in job.stages}
    done = clips = 0
    for ref in refs:
        marks = _marks(job, ref)
        for mark in marks:
            stages[mark["stage"]][mark["status"]] += 1
            for name in ("seconds", "cpu_seconds"):
                stages[mark["stage"]][name] += mark[name]
        last = marks[-1]
        if last["status"] == "failed":
            quarantined.append({name: last[name] for name in _ROW})
            continue
        windows.update(last["summary"]["windows"])
        clips += last["records"]
        done += bool(last["records"])
        if not last["records"]:
            filtered[ref.id] = _told(last["summary"]["windows"])
    for row in stages.values():
        row["clips_per_second"] = clips / row["seconds"] if row["seconds"] else None
    return Counts(len(refs) + len(refused), done, filtered, quarantined, dict(windows), stages)


def write_tables(folder: Path, counts: Counts, **more: Any) -> None:
    """Writes the quarantine table (a JSON object per line) and the summary, which has everything else and ``more``."""
    with disk_guard(folder):
        rows = [json.dumps(row) for row in counts.quarantined]
        write_atomically(folder / QUARANTINE, "".join(f"{row}\n" for row in rows).encode())
        summary = dataclasses.asdict(counts) | {"quarantined": len(counts.quarantined)} | more
        write_atomically(folder / SUMMARY, json.dumps(summary, indent=1).encode())


def _marks(job: Job, ref: EpisodeRef) -> list[Mark]:
    """An episode's, up to the first failed one."""
    marks: list[Mark] = []
    for stage in job.stages:
        unit = Unit(ref, stage.name)
        mark = job.mark(unit)
        if mark is None:
            raise UserError(f"{job.output(unit)}: not there; the job is not finished, run it again")
        marks.append(mark)
        if mark["status"] == "failed":
            break
    return marks


_ROW = ("episode", "stage", "key", "error", "traceback")


def _told(windows: dict[str, int]) -> str:
    left = [f"{number} {reason}" for reason, number in windows.items() if number]
    return f"windows left out: {', '.join(left)}" if left else "shorter than a window"
