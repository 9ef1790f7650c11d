import fcntl
import json
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.soak import soak as module
from benchmarks.soak.__main__ import training_arguments
from benchmarks.soak.faults import FULL_DISK, SHARES
from benchmarks.soak.rounds import SoakError
from benchmarks.soak.runs import Options, Soak, without
from benchmarks.soak.soak import run_soak
from benchmarks.soak.table import HEADER, conclusion, markdown, passed, rows
from rsjax.config import presets
from tests.benchmarks.soak.conftest import Dummies

TRIAL = {"record": 3, "quarantined": [3], "differences": [], "problem": "", "passed": True}


@pytest.fixture
def soak(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: Dummies) -> Soak:
    """A soak of runs that only look like training, and end as the reference."""
    monkeypatch.setattr(module, "prepare", lambda soak, place: target(place))
    monkeypatch.setattr(module, "make_reference", lambda soak, show: None)
    monkeypatch.setattr(module, "compare_with_reference", lambda soak, place: [])
    monkeypatch.setattr(module, "try_bad_record", lambda soak, show: TRIAL)
    monkeypatch.setattr(module, "SHARES", {kind: share for kind, share in SHARES.items() if "SIG" in kind})
    monkeypatch.setattr(module, "can_mount", lambda place: True)
    arguments = ("debug", "--train.steps", "60")
    return Soak(presets.debug(), arguments, Options(minutes=0.02, out=tmp_path / "out", data_dir=tmp_path))


def test_rounds_go_on_until_the_time_is_up_and_a_second_start_adds_nothing(soak: Soak) -> None:
    shown: list[str] = []
    result = run_soak(soak, "the command", shown.append)
    assert passed(result)
    assert sum(one["seconds"] for one in result["rounds"]) >= 60 * soak.options.minutes
    assert [one["number"] for one in result["rounds"]] == list(range(1, len(result["rounds"]) + 1))
    assert any("left]" in line or "[time is up]" in line for line in shown)  # on a busy machine, at once
    assert json.loads((soak.out / "soak.json").read_text()) == result
    assert "the command" in (soak.out / "soak.md").read_text()
    assert not (soak.out / "round").exists()
    assert run_soak(soak, "the command", shown.append) == result
    longer = sum(one["seconds"] for one in result["rounds"]) / 60 + 0.01
    more = run_soak(change(soak, minutes=longer), "the command", shown.append)
    assert more["rounds"][: len(result["rounds"])] == result["rounds"]
    assert len(more["rounds"]) > len(result["rounds"])


def test_a_run_that_ended_differently_fails_the_soak_and_is_kept(soak: Soak, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "compare_with_reference", lambda soak, place: ["weights: w differs"])
    result = run_soak(soak, "", print)
    assert not passed(result)
    assert (soak.out / "failed-1" / "run" / "stage" / "log.jsonl").exists()
    assert "weights: w differs" in (soak.out / "soak.md").read_text()


def test_another_soak_in_the_same_place_is_refused(soak: Soak) -> None:
    run_soak(soak, "", print)
    with pytest.raises(SoakError, match=r"holds another soak \(seed 0 there, 1 here\); choose another --out"):
        run_soak(change(soak, seed=1), "", print)
    with (soak.out / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(SoakError, match="another soak runs here"):
            run_soak(soak, "", print)


def test_without_mounting_there_are_no_full_disks_and_the_page_says_so(
    soak: Soak, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SHARES", {FULL_DISK: 100, "SIGTERM": 1})
    monkeypatch.setattr(module, "can_mount", lambda place: False)
    result = run_soak(soak, "", print)
    assert {event["kind"] for one in result["rounds"] for event in one["events"]} <= {"SIGTERM"}
    assert "No full disks" in (soak.out / "soak.md").read_text()


def change(soak: Soak, **options: Any) -> Soak:
    return replace(soak, options=replace(soak.options, **options))


def result(**changes: Any) -> dict[str, Any]:
    rng = random.Random(0)
    events = [
        {"kind": kind, "survived": True, "repeated": rng.randrange(9), "lost": rng.uniform(1, 9)}
        for kind in ["SIGTERM", *SHARES, "SIGTERM"]
    ]
    one = {"number": 1, "starts": 10, "seconds": 100.0, "problem": "", "differences": [], "events": events}
    whole = {"of": {"arguments": ["debug"]}, "command": "", "made_with": "", "notes": [], "bad_record": TRIAL}
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
    "failure", [{"problem": "exit status 1: gone"}, {"differences": ["weights: w differs"]}, {"events": "lost"}]
)
def test_any_failure_fails_the_soak_and_is_named(failure: dict[str, Any]) -> None:
    assert passed(result())
    if failure.get("events"):
        event = {"kind": "SIGTERM", "survived": False, "repeated": 0, "lost": 0.0}
        assert not passed(result(events=[event]))
        return
    assert not passed(result(**failure))
    assert any("Round 1: " in line for line in conclusion(result(**failure)))
    assert conclusion(result(**failure))[1].startswith("1 of 2 runs")


def test_a_soak_without_a_round_or_with_a_failed_record_has_not_passed() -> None:
    assert not passed(result() | {"rounds": []})
    assert not passed(result() | {"bad_record": {"passed": False}})


def test_training_gets_the_arguments_that_are_not_the_soaks_own() -> None:
    argv = "tiny --minutes 30 --train.steps 9 --out=here --data_dir there --train.curriculum two.json --seed 4"
    kept = "tiny --train.steps 9 --train.curriculum two.json"
    assert " ".join(training_arguments(argv.split())) == kept


def test_options_of_the_soak_replace_those_of_the_user() -> None:
    argv = ("tiny", "--train.steps=9", "--train.log_every", "5", "--train.seed", "1")
    assert without(argv, {"--train.steps", "--train.log-every"}) == ("tiny", "--train.seed", "1")
