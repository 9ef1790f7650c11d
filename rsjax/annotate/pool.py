"""An executor of worker processes on this machine, each of which may be killed without the others noticing."""

import multiprocessing
import os
import signal
import threading
import traceback
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from rsjax.annotate.runner import Outcome, limit_threads, opened
from rsjax.annotate.units import Job, Mark, Unit, Work, run_unit
from rsjax.errors import UserError


@dataclass
class _Worker:
    """One process, the pipe to it, and the unit that it has, or had when it died."""

    process: BaseProcess
    pipe: Connection
    unit: Unit | None = None


class ProcessPool:
    """Processes that each do one unit at a time, of whatever stage. Use it as a context manager, or close it.

    Args:
        job: sent to each worker once.
        workers: how many; at least 1.
    """

    def __init__(self, job: Job, workers: int) -> None:
        self._job = job
        self._context = multiprocessing.get_context("spawn")  # a forked JAX or PyTorch does not work
        self._threads = max(1, len(os.sched_getaffinity(0)) // workers)
        self._workers = [self._start() for _ in range(workers)]

    def pids(self) -> list[int]:
        """The workers' process ids."""
        return [worker.process.pid or 0 for worker in self._workers]

    def accepts(self, stage: str) -> bool:
        return any(worker.unit is None for worker in self._workers)

    def submit(self, unit: Unit) -> None:
        worker = next(worker for worker in self._workers if worker.unit is None)
        worker.unit = unit
        try:
            worker.pipe.send(unit)
        except OSError:  # it died while it was idle: told by the next wait, like any other death
            worker.process.kill()

    def wait(self) -> list[Outcome]:
        busy = {worker.pipe: worker for worker in self._workers if worker.unit is not None}
        outcomes = []
        for pipe in wait(list(busy)):
            worker = busy[pipe]  # type: ignore[index]
            unit, worker.unit = worker.unit, None
            assert unit is not None
            outcomes.append(Outcome(unit, self._receive(worker)))
        return outcomes

    def close(self) -> None:
        for worker in self._workers:
            worker.process.kill()  # what it may be writing has no name yet
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()

    def __enter__(self) -> "ProcessPool":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self) -> _Worker:
        here, there = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(self._job, there, self._threads), daemon=False)
        process.start()
        there.close()
        return _Worker(process, here)

    def _receive(self, worker: _Worker) -> Mark | None:
        try:
            answer = worker.pipe.recv()
        except (EOFError, OSError):
            worker.process.kill()
            worker.process.join()
            worker.pipe.close()
            self._workers[self._workers.index(worker)] = self._start()
            return None
        if isinstance(answer, BaseException):
            raise answer
        return answer


def _serve(job: Job, pipe: Connection, threads: int) -> None:
    """In a worker: units in, marks out, until the pipe is closed; signals are its parent's to answer."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    limit_threads(threads)
    works: dict[str, Work] = {}
    while True:
        try:
            unit = pipe.recv()
        except EOFError:
            return
        try:
            answer: Mark | Exception = run_unit(job, unit, opened(job, unit.stage, works))
        except UserError as error:
            answer = error
        except Exception as error:  # a bug, whose traceback a pipe does not carry
            error.add_note(traceback.format_exc())
            answer = error
        pipe.send(answer)


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
