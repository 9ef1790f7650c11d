import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from rsjax.ingest.clips import ClipConfig
from rsjax.ingest.ingest import Plan, ingest
from rsjax.ingest.jobs.ray_runner import RayError, RayExecutor
from rsjax.ingest.jobs.runner import Executor, Inline, run
from rsjax.ingest.jobs.work_items import Job
from rsjax.ingest.report import count
from rsjax.ingest.stages import Annotators, make_stages
from rsjax.ingest.windows import WindowConfig
from tests.ingest.toy import Source, job, runs

ray = pytest.importorskip("ray")
ROOT = Path(__file__).parents[2]


def test_a_local_ray_survives_what_the_pool_survives(tmp_path: Path) -> None:
    """An actor is killed in the middle of a unit, another one while it is idle; one unit fails."""
    kills = str(tmp_path / "killed")
    work = job(tmp_path, Source(6, broken=(4,)), fatal="episode_001", kills=kills, fails="episode_002")
    refs = list(work.source.episodes())
    with RayExecutor(work, workers={"first": 2, "second": 1}, cpus=3) as executor:
        pids = executor.pids()
        assert len(set(pids["first"] + pids["second"])) == 3
        os.kill(pids["second"][0], signal.SIGKILL)
        ran = run(work, refs, executor, lambda done, total: None)
    counts = count(work, refs)
    assert (counts.done, len(counts.quarantined), ran.units) == (4, 2, 10)
    assert ran.clips == 8
    assert "no such colour" in counts.quarantined[0]["error"] and "in _work" in counts.quarantined[0]["traceback"]
    assert runs(tmp_path).count("first episode_001") == 2
    assert not ray.is_initialized()


@pytest.fixture(scope="class")
def cluster() -> Iterator[None]:
    """Three CPUs and a GPU, which is only said to be there; Ray schedules by what is said."""
    ray.init(address="local", num_cpus=3, num_gpus=1, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


class Holder:
    """Of resources."""

    def held(self) -> bool:
        return True


@pytest.mark.usefixtures("cluster")
class TestOnAClusterThatIsThere:
    def test_four_workers_share_a_gpu(self, tmp_path: Path) -> None:
        work = job(tmp_path, Source(8), cpus=0.5, gpus=0.25)
        refs = list(work.source.episodes())
        with RayExecutor(work, workers={"second": 1}) as executor:
            pids = executor.pids()
            assert (len(set(pids["first"])), len(pids["second"])) == (4, 1)
            assert ray.available_resources().get("GPU", 0) == 0
            run(work, refs, executor, lambda done, total: None)
        assert count(work, refs).done == 8
        assert ray.is_initialized()  # it was here before

    def test_stores_are_the_same_as_without_ray(self, tmp_path: Path) -> None:
        config = ClipConfig(WindowConfig(frames=4), image_size=8, tracks=6)
        for name in ("ray", "alone"):
            stages = make_stages(Annotators(), config, cpus=0.5)
            work = Job(Source(4, broken=(2,), depth=True), "", stages, tmp_path / f"{name}.work")
            start: Callable[[], Executor] = partial(RayExecutor if name == "ray" else Inline, work)
            ingest(Plan(work, tmp_path / name, 0.25, {}), start, lambda done, total: None)
        ray_store, alone = ({p.name: p.read_bytes() for p in (tmp_path / n).iterdir()} for n in ("ray", "alone"))
        assert ray_store == alone and "manifest.json" in alone

    def test_a_worker_that_finds_no_place_is_waited_for_and_then_told(self, tmp_path: Path) -> None:
        """The cluster has the GPU, but another job has it."""
        other = ray.remote(num_cpus=0, num_gpus=1)(Holder).remote()
        assert ray.get(other.held.remote())
        work = job(tmp_path, Source(3), gpus=0.5)
        with pytest.raises(RayError, match=r"no place for a worker of first within 3 s"):
            RayExecutor(work, patience=3)
        letting_go = threading.Timer(3, ray.kill, [other])
        letting_go.start()
        refs = list(work.source.episodes())
        with RayExecutor(work) as executor:
            run(work, refs, executor, lambda done, total: None)
        assert count(work, refs).done == 3


def test_a_stage_that_no_node_can_hold_is_told(tmp_path: Path) -> None:
    work = job(tmp_path, Source(1), gpus=0.5)
    with pytest.raises(RayError, match=r"3 CPUs and 0 GPUs, too few.*lower --cpus or --gpus"):
        RayExecutor(work, cpus=3)
    assert not ray.is_initialized()


PROGRAM = """
import sys
from pathlib import Path
from rsjax.ingest.jobs.ray_runner import RayExecutor
from rsjax.ingest.jobs.runner import run
from tests.ingest.toy import Source, job
if __name__ == "__main__":
    work = job(Path(sys.argv[1]), Source(6), seconds=0.3)
    with RayExecutor(work, cpus=3) as executor:
        print(*sum(executor.pids().values(), []), flush=True)
        run(work, list(work.source.episodes()), executor, lambda done, total: None)
"""


def test_a_killed_driver_takes_its_cluster_along_and_only_the_rest_is_run(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    line = [sys.executable, str(program), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    driver = subprocess.Popen(line, env=environment, stdout=subprocess.PIPE, text=True)
    assert driver.stdout is not None
    pids = [int(word) for word in driver.stdout.readline().split()]
    assert len(pids) == 3
    wait_for(lambda: len(list(tmp_path.rglob("units/second/**/*.json"))) >= 1)
    driver.kill()
    driver.wait()
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids))
    marks = len(list(tmp_path.rglob("units/**/*.json")))
    assert 0 < marks < 12
    started = len(runs(tmp_path))
    work = job(tmp_path, Source(6))
    refs = list(work.source.episodes())
    with RayExecutor(work, cpus=2) as executor:
        run(work, refs, executor, lambda done, total: None)
    assert count(work, refs).done == 6
    assert len(runs(tmp_path)) - started == 12 - marks


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)
