import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import pytest

from rsjax.errors import UserError
from rsjax.processes import WorkerDied, count_workers, run_items
from tests.waiting import wait_until

ROOT = Path(__file__).parents[1]


class Square:
    """Squares numbers, and writes a line to a log for each; some numbers kill their worker or raise an error."""

    def __init__(self, log: Path, deadly: tuple[int, ...] = (), once: int = -1, bad: int = -1, wrong: int = -1) -> None:
        self.log, self.deadly, self.once, self.bad, self.wrong = log, deadly, once, bad, wrong

    def __call__(self, number: int) -> int:
        first = str(number) not in lines(self.log)
        with self.log.open("a") as file:
            file.write(f"{number}\n")
        if number in self.deadly or (number == self.once and first):
            os.kill(os.getpid(), signal.SIGKILL)
        if number == self.bad:
            raise ValueError("no such number")
        if number == self.wrong:
            raise UserError("number 7: too odd; take another")
        os.kill(os.getpid(), signal.SIGTERM)  # a scheduler may send it to all processes; only the parent answers it
        os.kill(os.getpid(), signal.SIGINT)
        return number * number


class Forking:
    """Starts a child that inherits all that the worker has open, and then kills the worker."""

    def __init__(self, pids: Path) -> None:
        self.pids = pids

    def __call__(self, number: int) -> WorkerDied:
        if child := os.fork():
            (self.pids / str(child)).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(600)
        os._exit(1)


def make_square(log: Path, options: dict[str, Any]) -> Square:
    return Square(log, **options)


def lines(log: Path) -> list[str]:
    return log.read_text().split() if log.exists() else []


def squares(
    log: Path, count: int, workers: int, settled: Callable[[], None] = lambda: None, **options: Any
) -> dict[int, int | WorkerDied]:
    """Squares the numbers below ``count``, and calls ``settled`` after each."""
    results: dict[int, int | WorkerDied] = {}

    def settle(number: int, square: int | WorkerDied) -> None:
        assert number not in results
        results[number] = square
        settled()

    run_items(partial(make_square, log, options), range(count), workers, settle)
    assert not multiprocessing.active_children()
    return results


def test_without_workers_this_process_does_it_all() -> None:
    results: dict[int, int] = {}
    run_items(lambda: lambda number: number + os.getpid(), range(3), 0, results.__setitem__)  # type: ignore[arg-type]
    assert results == {number: number + os.getpid() for number in range(3)}


def test_a_killed_worker_costs_its_item_one_more_try_and_the_others_nothing(tmp_path: Path) -> None:
    results = squares(tmp_path / "log", 6, 2, deadly=(3,), once=1)
    died = results.pop(3)
    assert isinstance(died, WorkerDied) and "2 workers died over it" in str(died)
    assert results == {number: number * number for number in (0, 1, 2, 4, 5)}
    assert sorted(lines(tmp_path / "log")) == ["0", "1", "1", "2", "3", "3", "4", "5"]


def test_a_worker_that_is_killed_while_idle_is_replaced(tmp_path: Path) -> None:
    def kill() -> None:
        for process in multiprocessing.active_children():
            process.kill()

    assert squares(tmp_path / "log", 2, 1, kill) == {0: 0, 1: 1}


def test_a_worker_whose_child_outlives_it_is_not_waited_for(tmp_path: Path) -> None:
    results: list[WorkerDied] = []
    run_items(partial(Forking, tmp_path), [0], 1, lambda number, result: results.append(result))
    assert [type(result) for result in results] == [WorkerDied]
    children = [int(path.name) for path in tmp_path.iterdir()]
    assert len(children) == 2
    for child in children:
        os.kill(child, signal.SIGKILL)


def test_a_worker_is_started_when_there_is_an_item_for_it(tmp_path: Path) -> None:
    alive: list[int] = []
    squares(tmp_path / "log", 1, 4, lambda: alive.append(len(multiprocessing.active_children())))
    assert alive == [1]


def test_errors_end_the_run_bugs_with_their_traceback(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no such number") as bug:
        squares(tmp_path / "log", 3, 1, bad=1)
    assert "in __call__" in bug.value.__notes__[0] and lines(tmp_path / "log") == ["0", "1"]
    with pytest.raises(UserError, match=r"^number 7: too odd; take another$") as error:
        squares(tmp_path / "log", 1, 1, wrong=0)
    assert not hasattr(error.value, "__notes__") and not multiprocessing.active_children()


def test_a_start_that_is_interrupted_leaves_no_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start, pids = BaseProcess.start, list[int]()

    def interrupted(process: BaseProcess) -> None:
        start(process)
        pids.append(process.pid or 0)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(BaseProcess, "start", interrupted)
    with pytest.raises(KeyboardInterrupt):
        squares(tmp_path / "log", 1, 2)
    assert len(pids) == 1 and not Path(f"/proc/{pids[0]}").exists()


PROGRAM = """
import multiprocessing
import sys
import threading
import time
from functools import partial
from pathlib import Path
from rsjax.processes import run_items

def work(item):
    Path(sys.argv[1], "working").touch()
    time.sleep(600)

def load():
    Path(sys.argv[1], "loading").touch()
    time.sleep(600)

class Slow:
    def __call__(self):
        return work

    def __reduce__(self):
        return (load, ()) if sys.argv[2] == "loading" else (Slow, ())

def tell():
    while len(children := multiprocessing.active_children()) < 2:
        time.sleep(0.01)
    print(*(child.pid for child in children), flush=True)

if __name__ == "__main__":
    threading.Thread(target=tell).start()
    run_items(Slow(), range(2), 2, print)
"""


@pytest.mark.parametrize("when", ["starting", "loading", "working"])
def test_a_killed_parent_takes_its_workers_along(tmp_path: Path, when: str) -> None:
    """The parent is killed at once, while a worker loads its task, or while it works on it."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    line = [sys.executable, str(program), str(tmp_path), when]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    parent = subprocess.Popen(line, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pids = [int(word) for word in parent.stdout.readline().split()]
    wait_until(lambda: when == "starting" or (tmp_path / when).exists())
    parent.kill()
    _, errors = parent.communicate()
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids))
    assert len(pids) == 2 and errors == ""


def test_workers_are_as_many_as_asked_for_within_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1, 2})
    assert [count_workers(workers) for workers in (-1, 0, 1, 12)] == [3, 0, 1, 12]
    for workers in (-7, -2, 13, 100_000):
        with pytest.raises(UserError, match=rf"^--workers is {workers};"):
            count_workers(workers)
