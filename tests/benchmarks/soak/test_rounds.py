import itertools
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.soak.attempt import Attempt, finished
from benchmarks.soak.faults import (
    KILL_COMPILING,
    KILL_STARTING,
    KILL_TRAINING,
    KILL_WRITING,
    SHARES,
    TERMINATE,
    Fault,
    damage_file,
    schedule,
)
from benchmarks.soak.rounds import Event, run_round, settle
from tests.benchmarks.soak.conftest import Dummies
from tests.benchmarks.soak.dummy import STEPS
from tests.waiting import wait_until


def test_a_round_goes_on_after_every_fault_until_the_run_is_finished(target: Dummies) -> None:
    said: list[str] = []
    hit = target()
    kinds = iter([KILL_COMPILING, KILL_WRITING, TERMINATE, KILL_TRAINING])
    done = run_round(hit, kinds, random.Random(0), show=said.append)
    assert done.problem == ""
    assert hit.current is None
    assert len(done.events) >= 3
    assert all(event.survived for event in done.events)
    assert done.starts == len(done.events) + 1
    assert {event.fault.kind for event in done.events} <= SHARES.keys()
    assert sum("went on from step" in line for line in said) >= 2
    lines = (hit.trained[0] / "log.jsonl").read_text().splitlines()
    assert [line.count('"step"') for line in lines] == [1] * STEPS, "a finished run has all its steps"


def test_a_run_is_left_to_finish_when_the_time_is_up(target: Dummies) -> None:
    done = run_round(target(), itertools.repeat(KILL_TRAINING), random.Random(0), time.monotonic(), print)
    assert (done.events, done.starts, done.problem) == ((), 1, "")


def test_another_status_after_sigterm_is_a_problem(target: Dummies) -> None:
    done = run_round(target(fault="deaf"), iter([TERMINATE]), random.Random(0), float("inf"), print)
    assert done.problem == "exit status 1, not 75"
    assert [event.survived for event in done.events] == [False]


def test_a_command_that_cannot_go_on_is_a_problem_with_its_last_line(target: Dummies) -> None:
    done = run_round(target(fault="broken"), iter([KILL_TRAINING]), random.Random(0), float("inf"), print)
    assert done.problem == "exit status 1: cannot go on"
    assert [event.survived for event in done.events] == [False]


def test_the_phases_of_a_start_are_seen_from_outside(target: Dummies) -> None:
    dummy = target()
    (folder,) = dummy.trained
    attempt = Attempt(dummy.command, dummy.trained, dummy.output)
    phases = [attempt.phase()]
    while attempt.alive:
        if (phase := attempt.phase()) != phases[-1]:
            phases.append(phase)
    # On a busy machine the start may be over before it is looked at.
    assert phases == ["starting", "compiling", "training"][-len(phases) :] and len(phases) > 1
    assert attempt.resumed == {folder: 0}
    assert attempt.first_step is not None and 0 < attempt.first_step < attempt.seconds


def test_steps_done_again_are_charged_once_and_every_start_to_the_fault_before_it(tmp_path: Path) -> None:
    events: list[Event] = []
    for step, attempt in ((17, None), (17, start(None, {}, 2.0)), (31, start(4.0, {tmp_path: 10}, 9.0))):
        if attempt is not None:
            settle(events, attempt, done=False)
        events.append(Event(Fault(KILL_TRAINING if step == 17 else KILL_STARTING), tmp_path, step))
    settle(events, start(None, {tmp_path: 30}, 3.0), done=True)
    assert [event.repeated for event in events] == [7, 0, 1]
    assert [event.seconds for event in events] == [2.0, 4.0, 3.0]
    assert [event.lost(0.5) for event in events] == [5.5, 4.0, 3.5]
    assert all(event.survived for event in events)


def start(first_step: float | None, resumed: dict[Path, int], seconds: float) -> Any:
    return SimpleNamespace(first_step=first_step, resumed=resumed, seconds=seconds)


@given(st.integers(0, 1000), st.integers(1, 3))
def test_the_schedule_has_every_kind_as_often_as_its_share(seed: int, times: int) -> None:
    size = sum(SHARES.values())
    kinds = list(itertools.islice(schedule(random.Random(seed), SHARES), times * size))
    assert {kind: kinds.count(kind) for kind in SHARES} == {kind: times * share for kind, share in SHARES.items()}


@pytest.mark.parametrize("seed", range(6))
def test_damage_hits_exactly_one_file(seed: int, tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    for name in ("one", "deep/two", "empty"):
        (tmp_path / name).write_bytes(b"" if name == "empty" else bytes(range(50)))
    before = contents(tmp_path)
    message = damage_file(tmp_path, random.Random(seed))
    after = contents(tmp_path)
    changed = [name for name in before if after.get(name) != before[name]]
    assert len(changed) == 1
    assert changed[0] in message


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_a_killed_soak_had_started_dies_with_it(target: Dummies, tmp_path: Path) -> None:
    if shutil.which("setpriv") is None:
        pytest.skip("util-linux's setpriv is not installed")
    dummy = target()
    code = (
        "import time; from pathlib import Path; from benchmarks.soak.attempt import Attempt; "
        f"attempt = Attempt({dummy.command!r}, [Path({str(dummy.trained[0])!r})], Path({str(dummy.output)!r})); "
        "print(attempt.process.pid, flush=True); time.sleep(600)"
    )
    soak = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert soak.stdout is not None
    child = int(soak.stdout.readline())
    command_line = Path(f"/proc/{child}/cmdline")
    wait_until(lambda: b"setpriv" not in command_line.read_bytes())  # then it has asked for the signal
    soak.kill()
    soak.wait()
    stat = Path(f"/proc/{child}/stat")
    wait_until(lambda: not stat.exists() or "Z" in stat.read_text().split())
    assert not finished(dummy.trained[0])
