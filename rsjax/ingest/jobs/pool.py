"""An executor of worker processes on this machine, each of which may be killed without the others noticing."""

import multiprocessing
import os
import pickle
import signal
import traceback
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from rsjax.config.fields import ConfigError
from rsjax.errors import UserError
from rsjax.ingest.jobs.runner import Outcome, limit_threads, opened
from rsjax.ingest.jobs.work_items import Job, Mark, Unit, Work, run_unit
from rsjax.ingest.jobs.worker import begin

MOST_PER_CORE = 4  # workers; more only take memory from each other


def check_workers(asked: int) -> int:
    """What ``--workers`` may be, whatever the runner: -1 or a number.

    Raises:
        ConfigError: it is below -1.
    """
    if asked < -1:
        raise ConfigError(f"--workers is {asked}; give a number, 0 for this process alone or -1 for one per core")
    return asked


def count_workers(asked: int) -> int:
    """How many processes of this machine ``--workers`` stands for; 0: none but this one.

    Raises:
        ConfigError: it is below -1, or more than :data:`MOST_PER_CORE` for each core.
    """
    cores = len(os.sched_getaffinity(0))
    if asked > MOST_PER_CORE * cores:
        told = f"{asked}; {cores} cores have work for {cores}, and {MOST_PER_CORE * cores} is the most"
        raise ConfigError(f"--workers is {told}: give fewer, or -1 for one per core")
    return cores if check_workers(asked) == -1 else asked


@dataclass
class _Worker:
    """One process, the pipe to it, and the unit that it has, or had when it died."""

    process: BaseProcess
    pipe: Connection
    unit: Unit | None = None


class ProcessPool:
    """Processes that each do one unit at a time, of whatever stage. Use it as a context manager, or close it.

    A process is started when there is a unit for it and no other is idle. It ends with the thread that submitted that
    unit, if not before.

    Args:
        job: sent to each worker once.
        workers: how many at most; at least 1.
    """

    def __init__(self, job: Job, workers: int) -> None:
        threads = max(1, len(os.sched_getaffinity(0)) // workers)
        self._most, self._first_message = workers, pickle.dumps((_serve, (job, threads)))
        self._context = multiprocessing.get_context("spawn")  # a forked JAX or PyTorch does not work
        self._workers: list[_Worker] = []

    def pids(self) -> list[int]:
        """The process ids of the workers that were started."""
        return [worker.process.pid or 0 for worker in self._workers]

    def accepts(self, stage: str) -> bool:
        return len(self._workers) < self._most or any(worker.unit is None for worker in self._workers)

    def submit(self, unit: Unit) -> None:
        worker = next((worker for worker in self._workers if worker.unit is None), None) or self._start()
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
        process = self._context.Process(target=begin, args=(os.getpid(), there), daemon=False)
        resource_tracker.ensure_running()  # it would unblock the signals
        # A worker inherits what is blocked: signals are its parent's to answer, which knows of the worker by then.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
        try:
            process.start()
            worker = _Worker(process, here)
            self._workers.append(worker)
        finally:
            there.close()
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        try:
            here.send_bytes(self._first_message)
        except OSError:
            process.kill()
        return worker

    def _receive(self, worker: _Worker) -> Mark | None:
        try:
            answer = worker.pipe.recv()
        except (EOFError, OSError):
            worker.process.kill()
            worker.process.join()
            worker.pipe.close()
            self._workers.remove(worker)
            return None
        if isinstance(answer, BaseException):
            raise answer
        return answer


def _serve(pipe: Connection, job: Job, threads: int) -> None:
    """In a worker: units in, marks out, until the pipe is closed."""
    limit_threads(threads)
    works: dict[str, Work] = {}
    while True:
        try:
            unit = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            answer: Mark | Exception = run_unit(job, unit, opened(job, unit.stage, works))
        except UserError as error:
            answer = error
        except Exception as error:  # a bug, whose traceback a pipe does not carry
            error.add_note(traceback.format_exc())
            answer = error
        try:
            pipe.send(answer)
        except OSError:
            return
