"""Work items: a work item is one step on one episode. It writes its own output, and a mark that says what made it.

Its key is a hash of all that its output depends on: what the episode was read from and how, the step's version and
parameters, and the keys of the steps whose output it reads. Output and mark are named by the key and appear complete,
the mark last, so a mark always stands for a complete output, even if a process is killed. Outputs of other parameters
stay beside it.
"""

import contextlib
import errno
import json
import os
import time
import traceback
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from array_record.python.array_record_module import ArrayRecordWriter

from rsjax.config import content_key
from rsjax.data.codec import Record, encode
from rsjax.data.store import WRITER_OPTIONS, Source
from rsjax.errors import UserError
from rsjax.files import disk_guard, parse_json, regular, safe_id, write_atomically
from rsjax.tools.ingest.episode import Episode, EpisodeRef, EpisodeSource

Summary = dict[str, Any]  # what a step says about its output, JSON-ready
# status, stage (the step), episode, key, seconds, cpu_seconds; done: records, bytes, summary; failed: error, option,
# traceback
ItemMark = dict[str, Any]
Inputs = Mapping[str, Source]  # the records of earlier steps, by their names
Records = Generator[Record, None, Summary]


@dataclass(frozen=True)
class Step:
    """One step on every episode, such as depth or tracks. Picklable.

    Attributes:
        name: its name, usable as a file name.
        work: returns an episode's records, one at a time, and a summary at the end.
        params: a hash of all parameters that the output depends on.
        needs: the earlier steps whose output it reads.
        version: to be raised when the same parameters give another output.
        prepare: loads heavy objects, once in each worker. A :class:`UserError` from it (a missing package, missing
            weights) ends the ingest, because no episode could be processed.
        cpus: CPUs of one worker, fractions allowed; a Ray cluster schedules by them.
        gpus: GPUs of one worker, likewise.
    """

    name: str
    work: Callable[[Episode, Inputs], Records]
    params: str
    needs: tuple[str, ...] = ()
    version: int = 1
    prepare: Callable[[], object] | None = None
    cpus: float = 1.0
    gpus: float = 0.0


class SplitShares(NamedTuple):
    """Shares of the episodes in the splits test and validation, the rest is train; the seed chooses which ones."""

    test: float = 0.1
    validation: float = 0.0
    seed: int = 0


ALL_TRAIN_BUT_A_TENTH = SplitShares()


@dataclass(frozen=True)
class IngestPlan:
    """The episodes, steps and store of an ingest. Picklable.

    Attributes:
        source: the episodes.
        steps: in order, each after those that it needs; the last one cuts the clips.
        out: the store.
        shares: those of the splits; all clips of an episode are in one split.
        reading: a hash of how episodes are read, as far as their fingerprints do not cover it.
        meta: further entries of the store's manifest.
    """

    source: EpisodeSource
    steps: tuple[Step, ...]
    out: Path
    shares: SplitShares = ALL_TRAIN_BUT_A_TENTH
    reading: str = ""
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def folder(self) -> Path:
        """The folder of outputs and marks. It is kept, so that an ingest with other parameters reuses what it can."""
        return self.out.with_name(f"{self.out.name}.work")

    @property
    def items(self) -> Path:
        """The part of the folder in which work items store their outputs and marks."""
        return self.folder / "items"

    def keys(self, ref: EpisodeRef) -> dict[str, str]:
        """Returns the key of each of an episode's work items, by step."""
        what = (ref.id, ref.fingerprint, self.source.name, self.reading)
        keys: dict[str, str] = {}
        for step in self.steps:
            needed = tuple(keys[name] for name in step.needs)
            keys[step.name] = content_key(*what, step.name, step.version, step.params, needed)
        return keys


class EpisodeWork:
    """The work items of one episode: their outputs and marks."""

    def __init__(self, plan: IngestPlan, ref: EpisodeRef) -> None:
        self.plan = plan
        self.ref = ref
        self.keys = plan.keys(ref)

    def output(self, step: str) -> Path:
        """Returns the path of a work item's output. An episode's name never leads out of the folder."""
        key = self.keys[step]
        return self.plan.items / step / key[:2] / f"{safe_id(self.ref.id)}-{key}.array_record"

    def mark(self, step: str) -> ItemMark | None:
        """Reads a work item's mark; None if it was not run, or its output is missing or truncated."""
        output = self.output(step)
        try:
            mark = parse_json(regular(mark_path(output)).read_bytes())
            numbers = [mark["seconds"], mark["cpu_seconds"]]
            if mark["status"] == "failed":
                whole = True
            else:
                numbers.append(mark["records"])
                whole = isinstance(mark["summary"], dict) and output.stat().st_size == mark["bytes"]
        except (OSError, ValueError, KeyError):
            return None
        sound = mark["status"] in ("done", "failed") and all(type(number) in (int, float) for number in numbers)
        if sound and whole:
            return mark
        return None

    def done(self, step: str) -> ItemMark | None:
        """Reads the mark of a work item that succeeded; None if it failed or was not run."""
        mark = self.mark(step)
        if mark is not None and mark["status"] == "done":
            return mark
        return None

    def records(self, step: str, count: int) -> Source:
        """Opens the ``count`` records of a work item that succeeded."""
        output = self.output(step)
        return Source(output.parent, step, [(output.name, count)] if count else [])

    def fail(self, step: str, error: BaseException, seconds: float = 0.0, cpu_seconds: float = 0.0) -> ItemMark:
        """Writes the mark of a failed work item, a row of the quarantine table."""
        if isinstance(error, UserError):
            message = str(error)
        else:
            message = f"{type(error).__name__}: {error}"
        row = {
            "error": " ".join(message.split()),
            "option": getattr(error, "option", ""),
            "traceback": "".join(traceback.format_exception(error)),
        }
        return self.leave(step, {"status": "failed", "seconds": seconds, "cpu_seconds": cpu_seconds, **row})

    def leave(self, step: str, mark: ItemMark) -> ItemMark:
        """Writes a work item's mark, so that it is not run again."""
        mark = {"episode": self.ref.id, "stage": step, "key": self.keys[step]} | mark
        path = mark_path(self.output(step))
        with disk_guard(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, json.dumps(mark).encode())
        return mark


def mark_path(output: Path) -> Path:
    """Returns the path of a work item's mark, beside its output."""
    return output.with_suffix(".json")


def run_episode(plan: IngestPlan, ref: EpisodeRef, prepared: set[str]) -> tuple[int, int]:
    """Runs the steps of an episode that have no mark, up to the first that fails.

    Args:
        prepared: the names of the steps that this worker has prepared; newly prepared ones are added.

    Returns:
        How many work items were run, and how many clips they made.

    Raises:
        UserError: no work item could be run here, for example because the disk is full or a package is missing.
    """
    work = EpisodeWork(plan, ref)
    ran = 0
    clips = 0
    for step in plan.steps:
        mark = work.mark(step.name)
        if mark is None:
            mark = run_item(work, step, prepared)
            ran += 1
            if step is plan.steps[-1]:
                clips += mark.get("records", 0)
        if mark["status"] == "failed":
            break
    return ran, clips


class _WorkError(Exception):
    """A step's work failed on an episode; ``__cause__`` is why."""


def run_item(work: EpisodeWork, step: Step, prepared: set[str]) -> ItemMark:
    """Runs a work item and writes its output and mark; an error of the work becomes a failed mark.

    Raises:
        UserError: the step cannot be prepared, or the output cannot be written; no other work item could be run either.
    """
    if step.prepare is not None and step.name not in prepared:
        step.prepare()
        prepared.add(step.name)
    wall = time.monotonic()
    cpu = time.process_time()
    output = work.output(step.name)
    temporary = output.with_name(f"{output.name}.{os.uname().nodename}-{os.getpid()}.tmp")
    with disk_guard(output):
        output.parent.mkdir(parents=True, exist_ok=True)
        try:
            count, summary = _write(temporary, _records(work, step))
            os.replace(temporary, output)
        except _WorkError as failure:
            error = failure.__cause__ or failure
            return work.fail(step.name, error, time.monotonic() - wall, time.process_time() - cpu)
        finally:
            temporary.unlink(missing_ok=True)
        seconds = {"seconds": time.monotonic() - wall, "cpu_seconds": time.process_time() - cpu}
        done = {"records": count, "bytes": output.stat().st_size, "summary": summary}
        return work.leave(step.name, {"status": "done"} | seconds | done)


def _records(work: EpisodeWork, step: Step) -> Records:
    inputs = {}
    for name in step.needs:
        mark = work.done(name)
        if mark is None:
            raise FileNotFoundError(f"{work.output(name)}: the output of {name} is missing; run again")
        inputs[name] = work.records(name, mark["records"])
    episode = work.plan.source.read(work.ref)
    origin = {name: value for name, value in work.ref.location.items() if isinstance(value, str | int)}
    # File names need not be valid text, but records must be.
    named = {k: v if isinstance(v, int) else v.encode(errors="backslashreplace").decode() for k, v in origin.items()}
    return (yield from step.work(replace(episode, meta=episode.meta | {"origin": named}), inputs))


def _write(path: Path, records: Records) -> tuple[int, Summary]:
    """Writes records as they come; returns their number and the summary that comes last."""
    count = 0
    with contextlib.closing(records), contextlib.closing(ArrayRecordWriter(str(path), WRITER_OPTIONS)) as writer:
        while True:
            try:
                record = next(records)
            except StopIteration as stop:
                return count, stop.value
            except Exception as error:
                if getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT):
                    raise  # the other work items would fail in the same way
                raise _WorkError from error
            writer.write(encode(record))
            count += 1
