"""Units of work: one stage on one episode. Each writes its own output, and a mark that says by what it was made.

A unit's key is a hash of all that its output depends on: what the episode was read from and how, the stage's version
and parameters, and the keys of the stages whose output it reads. Output and mark are named by the key and appear whole,
the mark last, so whatever is killed, a mark stands for a whole output. Outputs of other parameters stay beside it.
"""

import contextlib
import errno
import json
import os
import time
import traceback
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from array_record.python.array_record_module import ArrayRecordWriter

from rsjax.config import content_key
from rsjax.data.codec import Record, encode
from rsjax.data.store import WRITER_OPTIONS, Source
from rsjax.files import disk_guard, write_atomically
from rsjax.ingest.episode import Episode, EpisodeRef, EpisodeSource, safe_id

RECENT = 256  # episodes whose keys are kept
Summary = dict[str, Any]  # what a stage says of its output, JSON-ready, without the output being read
# status, stage, episode, key, seconds, cpu_seconds; done: records, bytes, summary; failed: error, traceback
Mark = dict[str, Any]
Inputs = Mapping[str, Source]  # the records of earlier stages, by their names
Work = Callable[[Episode, Inputs], Generator[Record, None, Summary]]


class Stage(Protocol):
    """One step on every episode, such as depth or tracks. Picklable; what is heavy is loaded by :meth:`open`.

    Attributes:
        name: a file name.
        version: raised when the same parameters give another output.
        needs: the earlier stages whose output it reads.
        cpus, gpus: of one worker, fractions allowed; a Ray cluster schedules by them.
    """

    @property
    def name(self) -> str: ...
    @property
    def version(self) -> int: ...
    @property
    def needs(self) -> tuple[str, ...]: ...
    @property
    def cpus(self) -> float: ...
    @property
    def gpus(self) -> float: ...

    def params(self) -> dict[str, Any]:
        """All that its output depends on, JSON-ready."""
        ...

    def open(self) -> Work:
        """What does the work, once per worker. A generator of records, one at a time, that returns its summary.

        Raises:
            UserError: it cannot run here at all (a package, weights); that ends the job.
        """
        ...


class UnitError(Exception):
    """A unit's work failed. ``__cause__`` is why."""


class Unit(NamedTuple):
    """One stage on one episode, as it travels to a worker."""

    ref: EpisodeRef
    stage: str


@dataclass(frozen=True)
class Job:
    """What is to be done. Picklable.

    Attributes:
        source: where the episodes are.
        reading: a hash of how they are read, as far as fingerprints do not say it.
        stages: in order; each after those that it needs.
        folder: where outputs and marks are kept.
    """

    source: EpisodeSource
    reading: str
    stages: tuple[Stage, ...]
    folder: Path

    def stage(self, name: str) -> Stage:
        return next(stage for stage in self.stages if stage.name == name)

    def keys(self, ref: EpisodeRef) -> dict[str, str]:
        """The key of each of an episode's units."""
        known = self._recent.get((ref.id, ref.fingerprint))
        if known is not None:
            return known
        what = (ref.id, ref.fingerprint, self.source.name, self.reading)
        keys: dict[str, str] = {}
        for stage in self.stages:
            needed = tuple(keys[name] for name in stage.needs)
            keys[stage.name] = content_key(*what, stage.name, stage.version, self._params[stage.name], needed)
        if len(self._recent) >= RECENT:
            self._recent.clear()
        self._recent[ref.id, ref.fingerprint] = keys
        return keys

    @cached_property
    def _recent(self) -> dict[tuple[str, str], dict[str, str]]:
        """Keys by id and fingerprint: each is asked for several times while its episode is under way."""
        return {}

    @cached_property
    def _params(self) -> dict[str, str]:
        """Each stage's parameters, hashed once: those of networks are the contents of files."""
        return {stage.name: content_key(stage.params()) for stage in self.stages}

    def output(self, unit: Unit) -> Path:
        """A unit's output; its mark is the same with ``.json``. An episode's name never leads out of the folder."""
        key = self.keys(unit.ref)[unit.stage]
        return self.folder / "units" / unit.stage / key[:2] / f"{safe_id(unit.ref.id)}-{key}.array_record"

    def mark(self, unit: Unit) -> Mark | None:
        """What the unit left, if it was run; None also where its output is gone or not whole."""
        output = self.output(unit)
        try:
            mark = json.loads(mark_path(output).read_text())
            whole = mark["status"] == "failed" or output.stat().st_size == mark["bytes"]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return mark if whole else None

    def records(self, unit: Unit, mark: Mark) -> Source:
        """The records of a unit that is done."""
        output = self.output(unit)
        return Source(output.parent, unit.stage, [(output.name, mark["records"])] if mark["records"] else [])


def mark_path(output: Path) -> Path:
    """Where a unit's mark lies, beside its output."""
    return output.with_suffix(".json")


def run_unit(job: Job, unit: Unit, work: Work) -> Mark:
    """Does a unit's work and leaves its output and mark; whatever goes wrong in the work becomes a failed mark.

    Raises:
        StoreError: the output cannot be written, which no other unit could either.
    """
    clock, output = _Clock(), job.output(unit)
    temporary = output.with_name(f"{output.name}.{os.uname().nodename}-{os.getpid()}.tmp")
    with disk_guard(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        try:
            count, summary = _write(temporary, _working(job, unit, work))
            os.replace(temporary, output)
            done = {"records": count, "bytes": output.stat().st_size, "summary": summary}
            return leave_mark(job, unit, {"status": "done"} | clock.read() | done)
        except UnitError as failure:
            return fail_unit(job, unit, failure.__cause__ or failure, clock.read())
        finally:
            temporary.unlink(missing_ok=True)


class _Clock:
    """Seconds since it was made, by the clock and of this process on all cores."""

    def __init__(self) -> None:
        self._wall, self._cpu = time.monotonic(), time.process_time()

    def read(self) -> dict[str, float]:
        return {"seconds": time.monotonic() - self._wall, "cpu_seconds": time.process_time() - self._cpu}


def fail_unit(job: Job, unit: Unit, error: BaseException, seconds: dict[str, float]) -> Mark:
    """Leaves a failed mark: a row of the quarantine table."""
    row = {
        "error": " ".join(f"{type(error).__name__}: {error}".split()),
        "option": getattr(error, "option", ""),
        "traceback": "".join(traceback.format_exception(error)),
    }
    return leave_mark(job, unit, {"status": "failed", **seconds, **row})


def leave_mark(job: Job, unit: Unit, mark: Mark) -> Mark:
    """Writes a unit's mark, which says that it need not be run again."""
    mark = {"episode": unit.ref.id, "stage": unit.stage, "key": job.keys(unit.ref)[unit.stage]} | mark
    path = mark_path(job.output(unit))
    with disk_guard(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(mark).encode())
    return mark


def _working(job: Job, unit: Unit, work: Work) -> Generator[Record, None, Summary]:
    """The work's records; its errors as :class:`UnitError`, but those that no other unit would be spared."""
    try:
        inputs = {}
        for name in job.stage(unit.stage).needs:
            earlier = Unit(unit.ref, name)
            mark = job.mark(earlier)
            if mark is None or mark["status"] != "done":
                raise FileNotFoundError(f"{job.output(earlier)}: the output of {name} is gone; run again")
            inputs[name] = job.records(earlier, mark)
        return (yield from work(job.source.read(unit.ref), inputs))
    except Exception as error:
        if getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise UnitError(str(error)) from error


def _write(path: Path, records: Generator[Record, None, Summary]) -> tuple[int, Summary]:
    """Writes records as they come; returns their number and the summary that comes last."""
    count, summary = 0, {}

    def noted() -> Iterator[Record]:
        nonlocal summary
        summary = yield from records

    writer = ArrayRecordWriter(str(path), WRITER_OPTIONS)
    try:
        for record in noted():
            writer.write(encode(record))
            count += 1
    finally:
        with contextlib.closing(records):
            writer.close()
    return count, summary
