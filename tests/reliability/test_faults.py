"""Processes that are really killed, stopped, damaged and run out of disk space, and end as if nothing had happened."""

import json
import random
import shutil
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.soak.attempt import Attempt, checkpoints, last_logged
from benchmarks.soak.compare import compare_stages
from benchmarks.soak.disk import can_mount, small_disk
from benchmarks.soak.faults import FAILED, FULL_DISK, KILL_TRAINING, SHARES, TERMINATE
from benchmarks.soak.rounds import Event, Target, run_round, run_without_faults
from rsjax.training.log import read_skipped
from tests.reliability.conftest import EVERY, STEPS, Targets

SEED = 0


def inject(target: Target, kinds: Iterator[str]) -> tuple[Event, ...]:
    """Runs a round, which has to be survived."""
    done = run_round(target, kinds, random.Random(SEED))
    assert done.problem == ""
    assert all(event.survived for event in done.events)
    assert done.starts == len(done.events) + 1
    return done.events


def test_a_run_with_every_kind_of_fault_ends_bit_identical_to_one_without(
    whole: Path, target: Targets, tmp_path: Path
) -> None:
    kinds = [*SHARES]
    if not can_mount(tmp_path):
        kinds.remove(FULL_DISK)
    random.Random(SEED).shuffle(kinds)
    print(f"seed {SEED}: {kinds}")
    hit = target("hit")
    events = inject(hit, iter(kinds))
    assert compare_stages(hit.trained[0], whole) == []
    stopped = [event for event in events if event.fault.kind == TERMINATE]
    assert [event.repeated for event in stopped] == [0] * len(stopped)


def test_steps_that_are_not_finite_are_left_out_and_listed_the_same_when_killed_between(
    whole: Path, target: Targets
) -> None:
    poisoned = ("--poisoned", 11, 12, 25)
    alone = target("alone", *poisoned)
    killed = target("killed", *poisoned)
    run_without_faults(alone)
    inject(killed, iter([KILL_TRAINING]))
    assert compare_stages(killed.trained[0], alone.trained[0]) == []
    assert compare_stages(alone.trained[0], whole) != []
    rows = read_skipped(alone.trained[0])
    assert [(row["step"], row["loss"]) for row in rows] == [(12, "nan"), (13, "nan"), (26, "nan")]
    assert [len(row["records"]) for row in rows] == [2, 2, 2]
    assert rows[0]["data"] != rows[1]["data"]


def test_a_full_disk_stops_the_command_in_one_line_and_leaves_the_last_checkpoint_as_it_was(
    whole: Path, target: Targets, tmp_path: Path
) -> None:
    if not can_mount(tmp_path):
        pytest.skip("mounting a small disk needs root and Linux")
    full = target("full")
    (folder,) = full.trained
    shutil.copytree(whole, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("weights", str(STEPS)))
    (folder / "made.json").write_text(json.dumps({"finished": False}))
    last = folder / "checkpoints" / str(STEPS - EVERY)
    before = checksums(last)
    with small_disk(folder, spare=1_000_000):
        attempt = Attempt(full.command, full.trained, full.output)
        assert attempt.process.wait() == FAILED
    output = full.output.read_text()
    assert "Traceback" not in output
    assert "disk is full" in output.splitlines()[-1]
    assert checkpoints(folder) == [STEPS - EVERY]
    assert checksums(last) == before
    run_without_faults(full)
    assert compare_stages(folder, whole) == []


def checksums(folder: Path) -> dict[Path, int]:
    return {path: zlib.crc32(path.read_bytes()) for path in folder.rglob("*") if path.is_file()}


def test_progress_is_read_from_a_folder(whole: Path) -> None:
    assert last_logged(whole) == STEPS
    assert checkpoints(whole) == [STEPS - EVERY, STEPS]
