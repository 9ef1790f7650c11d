import fcntl
import json
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from experiments.soak import training_arguments
from rsjax.config import presets
from rsjax.soak import soak as module
from rsjax.soak.bad_record import Trial
from rsjax.soak.disturb import FULL_DISK, SHARES
from rsjax.soak.runs import Plan, SoakError
from rsjax.soak.soak import soak
from rsjax.soak.table import HEADER, conclusion, markdown, passed, rows
from tests.soak.conftest import Dummies

TRIAL = Trial(3, (3,), (), "")


@pytest.fixture
def plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: Dummies) -> Plan:
    """A soak of runs that only look like training, and come out as the reference."""
    monkeypatch.setattr(module, "prepare", lambda plan, place: target(place))
    monkeypatch.setattr(module, "make_reference", lambda plan, say: None)
    monkeypatch.setattr(module, "differences", lambda plan, place: [])
    monkeypatch.setattr(module, "try_bad_record", lambda plan, say: TRIAL)
    monkeypatch.setattr(module, "SHARES", {kind: share for kind, share in SHARES.items() if "SIG" in kind})
    monkeypatch.setattr(module, "can_mount", lambda place: True)
    arguments = ("debug", "--train.steps", "60")
    return Plan(presets.debug(), arguments, "world_model", tmp_path / "out", tmp_path, None, 0.02, 0, 0)


def test_rounds_go_on_until_the_time_is_over_and_a_second_start_adds_nothing(plan: Plan) -> None:
    said: list[str] = []
    result = soak(plan, "the command", said.append)
    assert passed(result)
    assert sum(one["seconds"] for one in result["rounds"]) >= 60 * plan.minutes
    assert [one["number"] for one in result["rounds"]] == list(range(1, len(result["rounds"]) + 1))
    assert any("left]" in line for line in said)
    assert json.loads((plan.out / "soak.json").read_text()) == result
    assert "the command" in (plan.out / "soak.md").read_text()
    assert not (plan.out / "round").exists()
    assert soak(plan, "the command", said.append) == result
    longer = sum(one["seconds"] for one in result["rounds"]) / 60 + 0.01
    more = soak(replace(plan, minutes=longer), "the command", said.append)
    assert more["rounds"][: len(result["rounds"])] == result["rounds"]
    assert len(more["rounds"]) > len(result["rounds"])


def test_a_run_that_came_out_differently_fails_the_soak_and_is_kept(
    plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "differences", lambda plan, place: ["weights: w differs"])
    result = soak(plan, "", print)
    assert not passed(result)
    assert (plan.out / "failed-1" / "run" / "stage" / "log.jsonl").exists()
    assert "weights: w differs" in (plan.out / "soak.md").read_text()


def test_another_soak_in_the_same_place_is_refused(plan: Plan) -> None:
    soak(plan, "", print)
    with pytest.raises(SoakError, match=r"holds another soak \(seed 0 there, 1 here\); choose another --out"):
        soak(replace(plan, seed=1), "", print)
    with (plan.out / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(SoakError, match="another soak works here"):
            soak(plan, "", print)


def test_without_mounting_there_are_no_full_disks_and_the_page_says_so(
    plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SHARES", {FULL_DISK: 100, "SIGTERM": 1})
    monkeypatch.setattr(module, "can_mount", lambda place: False)
    result = soak(plan, "", print)
    assert {event["kind"] for one in result["rounds"] for event in one["events"]} <= {"SIGTERM"}
    assert "No full disks" in (plan.out / "soak.md").read_text()


def result(**changes: Any) -> dict[str, Any]:
    rng = random.Random(0)
    events = [
        {"kind": kind, "survived": True, "repeated": rng.randrange(9), "lost": rng.uniform(1, 9)}
        for kind in ["SIGTERM", *SHARES, "SIGTERM"]
    ]
    one = {"number": 1, "starts": 10, "seconds": 100.0, "problem": "", "differences": [], "events": events}
    trial = {"record": 3, "quarantined": [3], "differences": [], "problem": "", "passed": True}
    whole = {"of": {"arguments": ["debug"]}, "command": "", "made_with": "", "notes": [], "bad_record": trial}
    return whole | {"rounds": [one | changes, one | {"number": 2}]}


def test_the_table_adds_up() -> None:
    table = rows(result()["rounds"])
    assert all(len(row) == len(HEADER) for row in table)
    *kinds, total = table
    assert total[0] == "all"
    for column in (1, 2, 3):
        assert sum(int(row[column]) for row in kinds) == int(total[column])
    assert {row[0]: row[1] for row in kinds}["SIGTERM"] == "6"
    assert sum(float(row[4]) for row in kinds) == pytest.approx(float(total[4]), abs=len(kinds))
    assert all(row[0] in markdown(result()) for row in table)


@pytest.mark.parametrize(
    "fault", [{"problem": "exit status 1: gone"}, {"differences": ["weights: w differs"]}, {"events": "lost"}]
)
def test_any_fault_fails_the_soak_and_is_told(fault: dict[str, Any]) -> None:
    assert passed(result())
    if fault.get("events"):
        event = {"kind": "SIGTERM", "survived": False, "repeated": 0, "lost": 0.0}
        assert not passed(result(events=[event]))
        return
    assert not passed(result(**fault))
    assert any("Round 1: " in line for line in conclusion(result(**fault)))
    assert conclusion(result(**fault))[1].startswith("1 of 2 runs")


def test_a_soak_without_a_round_or_with_a_failed_record_has_not_passed() -> None:
    assert not passed(result() | {"rounds": []})
    assert not passed(result() | {"bad_record": {"passed": False}})


def test_training_gets_the_arguments_that_are_not_the_soaks_own() -> None:
    argv = "tiny --minutes 30 --train.steps 9 --out=here --data_dir there --train.stages simple:2 difficult:3 --seed 4"
    kept = "tiny --train.steps 9 --train.stages simple:2 difficult:3"
    assert " ".join(training_arguments(argv.split())) == kept
