import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Literal

import cv2
import pytest

from experiments.ingest import Options, make_executor
from rsjax.config import ConfigError
from rsjax.errors import UserError
from rsjax.files import FileError
from rsjax.ingest.episode import EpisodeRef
from rsjax.ingest.jobs.pool import ProcessPool, check_workers, count_workers
from rsjax.ingest.jobs.runner import Executor, Inline, limit_threads, run
from rsjax.ingest.jobs.work_items import Job, Unit, mark_path
from rsjax.ingest.report import Counts, count, write_tables
from tests.ingest.toy import Source, job, runs

ROOT = Path(__file__).parents[2]


def finish(work: Job, executor: Executor | None = None) -> Counts:
    """Runs it to its end, and counts; the numbers add up."""
    refs, told = list(work.source.episodes()), list[tuple[int, int]]()
    run(work, refs, executor or Inline(work), lambda done, total: told.append((done, total)))
    assert told[-1] == (len(refs) * len(work.stages), len(refs) * len(work.stages))
    counts = count(work, refs)
    assert counts.found == len(refs) == counts.done + len(counts.filtered) + len(counts.quarantined)
    return counts


def test_every_stage_runs_once_and_sees_the_one_before(tmp_path: Path) -> None:
    work = job(tmp_path, Source(3))
    counts = finish(work)
    assert counts.done == 3 and counts.windows == {"kept": 6}
    assert {name: row["done"] for name, row in counts.stages.items()} == {"first": 3, "second": 3}
    unit = Unit(next(work.source.episodes()), "second")
    assert work.records(unit, work.mark(unit) or {})[0]["from"] == [2]
    assert sorted(runs(tmp_path)) == sorted(
        f"{stage} episode_{n:03d}" for stage in ("first", "second") for n in range(3)
    )
    finish(work)
    assert len(runs(tmp_path)) == 6


def test_a_run_says_what_it_did_itself(tmp_path: Path) -> None:
    work = job(tmp_path, Source(3), seconds=0.02)
    refs = list(work.source.episodes())
    first = run(work, refs[:2], Inline(work), lambda done, total: None)
    assert (first.units, first.clips) == (4, 4) and first.seconds >= 4 * 0.02
    assert first.clips_per_second == pytest.approx(4 / first.seconds)
    rest = run(work, refs, Inline(work), lambda done, total: None)
    assert (rest.units, rest.clips) == (2, 2)
    stages = count(work, refs).stages
    assert stages["first"]["seconds"] >= 0.06
    assert stages["first"]["clips_per_second"] == pytest.approx(6 / stages["first"]["seconds"])


def test_a_worker_leaves_cores_to_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    before = cv2.getNumThreads()
    limit_threads(1)
    assert cv2.getNumThreads() == 1 and os.environ["OMP_NUM_THREADS"] == "1"
    cv2.setNumThreads(before)


def test_keys_are_the_same_when_they_are_asked_for_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rsjax.ingest.jobs.work_items.RECENT", 2)
    work, refs = job(tmp_path, Source(5)), list(Source(5).episodes())
    first = [work.keys(ref) for ref in refs]
    assert [work.keys(ref) for ref in refs] == first == [job(tmp_path, Source(5)).keys(ref) for ref in refs]
    assert len({key for keys in first for key in keys.values()}) == 10


def test_only_what_depends_on_a_change_runs_again(tmp_path: Path) -> None:
    finish(job(tmp_path, Source(2)))
    finish(job(tmp_path, Source(3)))
    assert len(runs(tmp_path)) == 6
    finish(job(tmp_path, Source(3, version="1")))
    assert len(runs(tmp_path)) == 12
    finish(job(tmp_path, Source(3), extra=1))
    assert len(runs(tmp_path)) == 18
    finish(job(tmp_path, Source(3)))
    assert len(runs(tmp_path)) == 18


def test_a_damaged_output_or_mark_is_made_again(tmp_path: Path) -> None:
    work = job(tmp_path, Source(2))
    finish(work)
    refs = list(work.source.episodes())
    os.truncate(work.output(Unit(refs[0], "second")), 100)
    mark_path(work.output(Unit(refs[1], "second"))).write_text("{")
    finish(work)
    assert sorted(runs(tmp_path)[4:]) == ["second episode_000", "second episode_001"]


def test_a_failing_unit_is_quarantined_with_its_traceback_and_the_others_go_on(tmp_path: Path) -> None:
    work = job(tmp_path, Source(4, broken=(1,)), fails="episode_002")
    counts = finish(work)
    assert counts.done == 2
    broken, failing = counts.quarantined
    assert (broken["episode"], broken["stage"]) == ("episode_001", "first")
    assert broken["error"] == "video_1.mp4: truncated; copy it again"
    assert failing["error"] == "ValueError: no such colour" and "in _work" in failing["traceback"]
    write_tables(tmp_path, counts)
    rows = [json.loads(line) for line in (tmp_path / "quarantine.jsonl").read_text().splitlines()]
    assert rows == counts.quarantined
    assert json.loads((tmp_path / "summary.json").read_text())["quarantined"] == 2
    assert not list(tmp_path.rglob("*.tmp"))
    before = runs(tmp_path)
    finish(work)
    assert runs(tmp_path) == before


@pytest.mark.parametrize("always", [False, True])
def test_a_killed_worker_costs_its_unit_one_more_try(tmp_path: Path, always: bool) -> None:
    kills = "" if always else str(tmp_path / "killed")
    work = job(tmp_path, Source(4), fatal="episode_001", kills=kills)
    with ProcessPool(work, 2) as pool:
        counts = finish(work, pool)
    assert counts.done == (3 if always else 4)
    assert [row["error"].partition(":")[0] for row in counts.quarantined] == ["WorkerDied"] * always
    assert runs(tmp_path).count("first episode_001") == 2
    assert len(runs(tmp_path)) == (8 if always else 9)


def test_an_idle_worker_that_was_killed_is_replaced(tmp_path: Path) -> None:
    work = job(tmp_path, Source(3))
    refs = list(work.source.episodes())
    with ProcessPool(work, 1) as pool:
        run(work, refs[:1], pool, lambda done, total: None)
        os.kill(pool.pids()[0], signal.SIGKILL)
        assert finish(work, pool).done == 3


def test_a_worker_is_started_when_there_is_a_unit_for_it(tmp_path: Path) -> None:
    work = job(tmp_path, Source(1))
    with ProcessPool(work, 4) as pool:
        assert pool.pids() == [] and pool.accepts("first")
        assert finish(work, pool).done == 1
        assert len(pool.pids()) == 1
        assert finish(work, pool).done == 1
        assert len(pool.pids()) == 1


def test_workers_are_as_many_as_asked_for_within_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1, 2})
    assert [count_workers(asked) for asked in (-1, 0, 1, 12)] == [3, 0, 1, 12]
    for asked in (-7, -2, 13, 100_000):
        with pytest.raises(ConfigError, match=rf"^--workers is {asked};"):
            count_workers(asked)
    assert [check_workers(asked) for asked in (-1, 0, 100_000)] == [-1, 0, 100_000]  # of a cluster
    with pytest.raises(ConfigError, match=r"^--workers is -2;"):
        check_workers(-2)


@pytest.mark.parametrize("runner", ["pool", "ray"])
def test_the_command_refuses_numbers_of_workers_that_cannot_be(tmp_path: Path, runner: Literal["pool", "ray"]) -> None:
    with pytest.raises(ConfigError, match=r"^--workers is -7;"):
        make_executor(job(tmp_path, Source(1)), Options(runner=runner, workers=-7))


def test_a_start_that_is_interrupted_leaves_no_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start = BaseProcess.start

    def interrupted(process: BaseProcess) -> None:
        start(process)
        os.kill(os.getpid(), signal.SIGINT)
        monkeypatch.undo()

    work = job(tmp_path, Source(1))
    pool = ProcessPool(work, 2)
    monkeypatch.setattr(BaseProcess, "start", interrupted)
    with pytest.raises(KeyboardInterrupt):
        finish(work, pool)
    (pid,) = pool.pids()
    assert Path(f"/proc/{pid}").exists()
    pool.close()
    assert not Path(f"/proc/{pid}").exists()


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


PROGRAM = """
import sys
from pathlib import Path
from rsjax.ingest.jobs.pool import ProcessPool
from rsjax.ingest.jobs.runner import run
from tests.ingest.toy import Source, job
if __name__ == "__main__":
    work = job(Path(sys.argv[1]), Source(6), seconds=0.2)
    with ProcessPool(work, 2) as pool:
        run(work, list(work.source.episodes()), pool, lambda done, total: print(*pool.pids(), flush=True))
"""


def test_a_killed_driver_takes_its_workers_along_and_only_the_rest_is_run(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    line = [sys.executable, str(program), str(tmp_path)]
    driver = subprocess.Popen(line, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert driver.stdout is not None and driver.stderr is not None
    pids = [int(word) for word in driver.stdout.readline().split()]
    wait_for(lambda: len(list(tmp_path.rglob("units/second/**/*.json"))) >= 1)
    driver.kill()
    driver.wait()
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids))
    assert driver.stderr.read() == ""
    marks = len(list(tmp_path.rglob("units/**/*.json")))
    assert 0 < marks < 12
    started = len(runs(tmp_path))
    assert finish(job(tmp_path, Source(6), seconds=0.0)).done == 6
    assert len(runs(tmp_path)) - started == 12 - marks
    assert len(list(tmp_path.rglob("units/**/*.array_record"))) == 12


SLOW = """
import sys
import time
from pathlib import Path
from rsjax.ingest.jobs.pool import ProcessPool
from rsjax.ingest.jobs.work_items import Unit
from tests.ingest.toy import Source, job

def load(place):
    Path(place).touch()
    time.sleep(100)

class Slow(Source):
    def __reduce__(self):
        return load, (sys.argv[1] + "/loading",)

if __name__ == "__main__":
    work = job(Path(sys.argv[1]), Slow(2))
    pool = ProcessPool(work, 2)
    for ref in work.source.episodes():
        pool.submit(Unit(ref, "first"))
    print(*pool.pids(), flush=True)
    time.sleep(100)
"""


@pytest.mark.parametrize("loading", [False, True])
def test_a_driver_that_is_killed_leaves_no_worker_that_is_starting(tmp_path: Path, loading: bool) -> None:
    """Killed at once, or when a worker reads what it is to do."""
    program = tmp_path / "program.py"
    program.write_text(SLOW)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    line = [sys.executable, str(program), str(tmp_path)]
    driver = subprocess.Popen(line, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert driver.stdout is not None
    pids = [int(word) for word in driver.stdout.readline().split()]
    wait_for(lambda: not loading or (tmp_path / "loading").exists())
    driver.kill()
    _, told = driver.communicate(timeout=60)
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids))
    assert len(pids) == 2 and told == "" and (tmp_path / "loading").exists() == loading


def test_a_full_disk_ends_the_job_with_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rsjax.ingest.jobs.work_items._write", full)
    with pytest.raises(FileError, match=r"disk is full"):
        finish(job(tmp_path, Source(2)))


def test_an_unfinished_job_is_not_counted(tmp_path: Path) -> None:
    work = job(tmp_path, Source(2))
    with pytest.raises(UserError, match=r"not finished, run it again"):
        count(work, list(work.source.episodes()))


def test_refused_episodes_are_rows_of_the_quarantine(tmp_path: Path) -> None:
    work = job(tmp_path, Source(1))
    finish(work)
    refs = list(work.source.episodes())
    counts = count(work, refs, [(EpisodeRef(refs[0].id, "0" * 16, {}), "id: twice")])
    assert (counts.found, counts.done, len(counts.quarantined)) == (2, 1, 1)
    assert counts.quarantined[0]["error"] == "id: twice"
