import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from rsjax.tools.ingest.annotate import Annotators
from rsjax.tools.ingest.episode import EpisodeRef
from rsjax.tools.ingest.ingest import Runner, ingest, run_on_this_machine
from rsjax.tools.ingest.ray_runner import RayError, check_answers, count_actors, run_on_ray
from rsjax.tools.ingest.summary import summarise
from rsjax.tools.ingest.work_items import IngestPlan, Step
from tests.tools.ingest.toy import Source, clip_plan, noting_plan, runs
from tests.waiting import wait_until

ROOT = Path(__file__).parents[3]


def steps(*wanted: tuple[float, float]) -> list[Step]:
    """Returns steps that need these CPUs and GPUs."""
    return [
        Step(str(number), lambda episode, inputs: iter(()), "", cpus=cpus, gpus=gpus)  # type: ignore[arg-type, return-value]
        for number, (cpus, gpus) in enumerate(wanted)
    ]


def test_actors_are_one_of_each_step_and_then_as_many_as_fit() -> None:
    both = steps((0.5, 0.25), (1.0, 0.0))
    assert count_actors(both, {"CPU": 8, "GPU": 1}) == {"0": 4, "1": 6}
    assert count_actors(both, {"CPU": 8, "GPU": 1}, most=3) == {"0": 3, "1": 3}
    assert count_actors(both, {"CPU": 1.5, "GPU": 1}) == {"0": 1, "1": 1}
    with pytest.raises(RayError, match=r"3 CPUs and 0 GPUs, too few.*lower --cpus or --gpus"):
        count_actors(steps((1.0, 0.5), (1.0, 0.0)), {"CPU": 3})


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Three CPUs and a GPU, which need not exist, as Ray schedules by declared resources."""
    ray = pytest.importorskip("ray")
    ray.init(address="local", num_cpus=3, num_gpus=1, include_dashboard=False, log_to_driver=False)
    yield ray
    ray.shutdown()


def with_needs(plan: IngestPlan, *needs: tuple[float, float]) -> IngestPlan:
    """Returns the plan with these CPUs and GPUs of its steps."""
    changed = (replace(step, cpus=cpus, gpus=gpus) for step, (cpus, gpus) in zip(plan.steps, needs, strict=True))
    return replace(plan, steps=tuple(changed))


def test_workers_share_a_gpu_and_survive_what_the_pool_survives(tmp_path: Path, cluster: Any) -> None:
    source = Source(6, broken=(4,))
    plan = noting_plan(tmp_path, source, once="episode_001", deadly="episode_003", fails="episode_002")
    plan = with_needs(plan, (0.5, 0.25), (1.0, 0.0))
    refs = list(source.episodes())
    ran = list[tuple[int, int]]()
    free = list[float]()

    def settle(ref: EpisodeRef, items: int, clips: int) -> None:
        ran.append((items, clips))
        free.append(cluster.available_resources().get("GPU", 0))

    run_on_ray(plan, refs, settle)
    assert sorted(ran) == [(1, 0), (1, 0), (1, 0), (2, 2), (2, 2), (2, 2)]
    assert min(free) <= 0.5  # two at least share it
    summary = summarise(plan, refs)
    errors = [row["error"] for row in summary.quarantined]
    assert summary.done == 3 and errors[0] == "ValueError: no such colour" and "truncated" in errors[2]
    assert errors[1].startswith("WorkerDied: 2 workers died over it")
    assert [runs(tmp_path).count(f"first episode_00{number}") for number in (0, 1, 3)] == [1, 2, 2]
    assert cluster.is_initialized()  # as it was before


def test_stores_are_the_same_from_ray_processes_and_this_process(tmp_path: Path, cluster: Any) -> None:
    runners: dict[str, Runner] = {
        "ray": run_on_ray,
        "processes": partial(run_on_this_machine, workers=2),
        "alone": run_on_this_machine,
    }
    stores = []
    for name, run in runners.items():
        methods = Annotators(motion=None, semantics=None)
        plan = clip_plan(tmp_path / name, Source(4, broken=(2,), deep=range(4)), methods)
        ingest(plan, run)
        stores.append({path.name: path.read_bytes() for path in plan.out.iterdir()})
    assert stores[0] == stores[1] == stores[2] and "manifest.json" in stores[0]


@pytest.mark.parametrize("address", ["127.0.0.1:{}", "ray://localhost:{}"])
def test_an_address_that_nobody_answers_is_named_at_once(address: str) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # without listening
        address = address.format(taken.getsockname()[1])
        with pytest.raises(RayError, match=rf"no Ray cluster at {address}: nobody answers \(.*refused\); start it"):
            check_answers(address)


def test_an_address_that_answers_or_is_none_is_left_to_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{server.getsockname()[1]}")
        for address in ("auto", "local", "nonsense", "host:²"):
            check_answers(address)


class Holder:
    """Occupies resources."""

    def holds(self) -> bool:
        return True


def test_a_step_without_a_place_is_waited_for_and_then_named(tmp_path: Path, cluster: Any) -> None:
    """The cluster has the GPU, but another user occupies it."""
    other = cluster.remote(num_cpus=0, num_gpus=1)(Holder).remote()
    assert cluster.get(other.holds.remote())
    plan = with_needs(noting_plan(tmp_path, Source(3)), (1.0, 0.5), (1.0, 0.0))
    refs = list(plan.source.episodes())
    with pytest.raises(RayError, match=r"no place for a worker of first within 0.1 s"):
        run_on_ray(plan, refs, lambda *ran: None, patience=0.1)
    leaving = threading.Timer(1, cluster.kill, [other])
    leaving.start()
    run_on_ray(plan, refs, lambda *ran: None)
    leaving.join()
    assert summarise(plan, refs).done == 3


PROGRAM = """
import sys
import time
from pathlib import Path
from rsjax.tools.ingest.ray_runner import run_on_ray
from tests.tools.ingest.toy import Source, noting_plan
if __name__ == "__main__":
    plan = noting_plan(Path(sys.argv[1]), Source(6), seconds=0.3)
    run_on_ray(plan, list(plan.source.episodes()), lambda *ran: time.sleep(600), cpus=3)
"""


def test_a_killed_driver_takes_its_cluster_along_and_only_the_rest_is_run(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    line = [sys.executable, str(program), str(tmp_path)]
    driver = subprocess.Popen(line, env=os.environ | {"PYTHONPATH": str(ROOT)})
    try:
        wait_until(lambda: driver.poll() is not None or bool(list(tmp_path.rglob("items/clips/**/*.json"))), 300)
    finally:
        driver.kill()
        driver.wait()
    pids = [path.name for path in (tmp_path / "pids").iterdir()]
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids))
    marks = len(list(tmp_path.rglob("items/**/*.json")))
    assert 0 < marks < 12
    started = len(runs(tmp_path))
    plan = noting_plan(tmp_path, Source(6))
    refs = list(plan.source.episodes())
    run_on_this_machine(plan, refs, lambda *ran: None)
    assert summarise(plan, refs).done == 6
    assert len(runs(tmp_path)) - started == 12 - marks
