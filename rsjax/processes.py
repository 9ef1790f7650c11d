"""Worker processes on this machine: the one way in which rsjax spreads work over cores.

A worker does one item at a time. If a worker is killed, most often by the kernel for lack of memory, the others carry
on, and one of them tries its item once more. Workers end with the process that started them, even if SIGKILL ends that
process.
"""

import ctypes
import multiprocessing
import os
import pickle
import signal
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterable
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Generic, NamedTuple, TypeVar

from rsjax.errors import UserError

MOST_PER_CORE = 4  # workers; more only take memory from each other
MAX_DEATHS = 2  # of workers over one item; the second death is blamed on the item and not on the machine
_LOOK_SECONDS = 1.0  # between looks at who is alive: a dead worker's children may keep its pipe open
_PR_SET_PDEATHSIG = 1  # linux/prctl.h

Item = TypeVar("Item")
Result = TypeVar("Result")


class WorkerDied(Exception):
    """The workers that were working on an item are gone; most often they were killed for lack of memory."""

    def __init__(self) -> None:
        super().__init__(f"{MAX_DEATHS} workers died over it, most likely for lack of memory; try fewer workers")


def count_cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def count_workers(workers: int) -> int:
    """Returns the number of processes that ``--workers`` stands for; 0 is this process alone.

    Raises:
        UserError: it is below -1, or more than :data:`MOST_PER_CORE` for each core.
    """
    cores = count_cores()
    if not -1 <= workers <= MOST_PER_CORE * cores:
        raise UserError(
            f"--workers is {workers}; give 1 to {MOST_PER_CORE * cores} ({cores} cores have work for {cores}), 0 for "
            f"this process alone or -1 for one per core"
        )
    return cores if workers == -1 else workers


class _Worker(NamedTuple):
    process: BaseProcess
    pipe: Connection


def run_items(
    make: Callable[[], Callable[[Item], Result]],
    items: Iterable[Item],
    workers: int,
    settle: Callable[[Item, Result | WorkerDied], None],
) -> None:
    """Works on items in processes, in no particular order, until all are settled.

    Args:
        make: called once in each worker, returns the function that does an item's work. Picklable, as are items and
            results.
        items: taken one by one, as workers become free.
        workers: the most processes to start; each is started when there is an item for it. 0: this process does all the
            work.
        settle: called in this process with each item and its result, or with :class:`WorkerDied` if
            :data:`MAX_DEATHS` workers died over the item.

    Raises:
        Exception: whatever the work raised; a bug carries the worker's traceback as a note.
    """
    if not workers:
        work = make()
        for item in items:
            settle(item, work(item))
        return
    first_message = pickle.dumps(make)
    fresh = ((item, 0) for item in items)
    again = deque[tuple[Item, int]]()
    started: list[_Worker] = []
    idle: list[_Worker] = []
    busy: dict[Connection, tuple[_Worker, Item, int]] = {}
    try:
        while True:
            while len(busy) < workers and (entry := again.popleft() if again else next(fresh, None)):
                worker = idle.pop() if idle else _start(first_message, started)
                busy[worker.pipe] = worker, *entry
                try:
                    worker.pipe.send(entry[0])
                except OSError:  # the worker died while it was idle; the next wait notices
                    worker.process.kill()
            if not busy:
                return
            ready = wait(list(busy), _LOOK_SECONDS)
            for pipe in [pipe for pipe in busy if pipe in ready or not busy[pipe][0].process.is_alive()]:
                worker, item, deaths = busy.pop(pipe)
                try:
                    if not pipe.poll():
                        raise EOFError
                    succeeded, answer = pipe.recv()
                except (EOFError, OSError):
                    started.remove(worker)
                    _stop([worker])
                    if deaths + 1 < MAX_DEATHS:
                        again.append((item, deaths + 1))
                    else:
                        settle(item, WorkerDied())
                    continue
                idle.append(worker)
                if not succeeded:
                    raise answer
                settle(item, answer)
    finally:
        _stop(started)


def _start(first_message: bytes, started: list[_Worker]) -> _Worker:
    """Starts a worker and adds it to ``started``, even if Ctrl-C or SIGTERM arrives in between."""
    context = multiprocessing.get_context("spawn")  # a forked JAX, PyTorch or OpenGL does not work
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(os.getpid(), there))
    resource_tracker.ensure_running()  # starting it later would unblock the signals
    # A worker inherits the blocked signals: its parent answers Ctrl-C and SIGTERM, and then stops the worker.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    started.append(_Worker(process, here))
    try:
        process.start()
    finally:
        there.close()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        here.send_bytes(first_message)
    except OSError:  # the worker has died already; the next wait notices
        process.kill()
    return started[-1]


def _stop(workers: list[_Worker]) -> None:
    """Kills workers, which is safe: the files that they are writing have temporary names."""
    begun = [worker for worker in workers if worker.process.pid is not None]
    for worker in begun:
        worker.process.kill()
    for worker in begun:
        worker.process.join()
    for worker in workers:
        worker.pipe.close()


def _serve(parent: int, pipe: Connection) -> None:
    """Answers each item with (True, result) or (False, error) until the parent closes the pipe. Runs in a worker."""
    if sys.platform == "linux":  # the kernel kills this process when its parent dies, whatever either is doing
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # the parent died before that
        os._exit(1)
    work = None
    try:
        first_message = pipe.recv_bytes()
        while True:
            item = pipe.recv()
            try:
                work = work or pickle.loads(first_message)()
                answer = True, work(item)
            except Exception as error:
                if not isinstance(error, UserError):  # a bug, whose traceback a pipe does not carry
                    error.add_note(traceback.format_exc())
                answer = False, error
            pipe.send(answer)
    except (EOFError, OSError):
        return


class Helper(Generic[Item, Result]):
    """One worker process that answers items in order, for as long as the thread that starts it lives.

    Args:
        make: called once in the process, returns the function that does an item's work. Picklable, as are items and
            results.
    """

    def __init__(self, make: Callable[[], Callable[[Item], Result]]) -> None:
        self._worker = _start(pickle.dumps(make), [])

    def __call__(self, item: Item, seconds: float) -> Result:
        """Returns an item's result. Raises what :meth:`send` and :meth:`receive` raise."""
        self.send(item)
        return self.receive(seconds)

    def send(self, item: Item) -> None:
        """Hands an item to the process, which works on it while this one goes on.

        Raises:
            WorkerDied: the process is gone.
        """
        try:
            self._worker.pipe.send(item)
        except OSError as error:
            self.close()
            raise WorkerDied from error

    def receive(self, seconds: float) -> Result:
        """Returns the result of the first item that was sent and not received.

        Raises:
            WorkerDied: the process is gone, or did not answer within ``seconds`` and was killed.
            Exception: whatever the work raised.
        """
        try:
            if not self._worker.pipe.poll(seconds):
                raise EOFError
            succeeded, answer = self._worker.pipe.recv()
        except (EOFError, OSError) as error:
            self.close()
            raise WorkerDied from error
        if not succeeded:
            raise answer
        return answer  # type: ignore[no-any-return]

    def close(self) -> None:
        """Kills the process."""
        _stop([self._worker])
