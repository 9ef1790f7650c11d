import json
import os
from pathlib import Path

import cv2
import pytest

from rsjax.errors import UserError
from rsjax.tools.ingest.ingest import limit_threads, run_on_this_machine
from rsjax.tools.ingest.summary import IngestSummary, summarise, write_tables
from rsjax.tools.ingest.work_items import EpisodeWork, IngestPlan, mark_path
from tests.tools.ingest.toy import Source, noting_plan, runs


def finish(plan: IngestPlan, workers: int = 0) -> IngestSummary:
    """Runs what is missing, and counts; every episode is settled once, and the numbers add up."""
    refs = list(plan.source.episodes())
    settled = list[str]()
    run_on_this_machine(plan, refs, lambda ref, items, clips: settled.append(ref.id), workers)
    assert sorted(settled) == [ref.id for ref in refs]
    summary = summarise(plan, refs)
    assert summary.episodes == len(refs) == summary.done + len(summary.filtered) + len(summary.quarantined)
    return summary


def test_every_step_runs_once_and_sees_the_one_before(tmp_path: Path) -> None:
    plan = noting_plan(tmp_path, Source(3))
    summary = finish(plan)
    assert summary.done == 3 and summary.windows == {"kept": 6}
    assert {name: row["done"] for name, row in summary.steps.items()} == {"first": 3, "clips": 3}
    work = EpisodeWork(plan, next(plan.source.episodes()))
    assert work.records("clips", 2)[0]["from"] == [2]
    assert sorted(runs(tmp_path)) == sorted(f"{step} episode_{n:03d}" for step in ("first", "clips") for n in range(3))
    finish(plan)
    assert len(runs(tmp_path)) == 6


def test_a_run_counts_what_it_did_itself(tmp_path: Path) -> None:
    plan = noting_plan(tmp_path, Source(3), seconds=0.02)
    refs = list(plan.source.episodes())
    ran = list[tuple[int, int]]()
    run_on_this_machine(plan, refs[:2], lambda ref, items, clips: ran.append((items, clips)))
    run_on_this_machine(plan, refs, lambda ref, items, clips: ran.append((items, clips)))
    assert ran == [(2, 2), (2, 2), (0, 0), (0, 0), (2, 2)]
    steps = summarise(plan, refs).steps
    assert steps["first"]["seconds"] >= 0.06
    assert steps["first"]["clips_per_second"] == pytest.approx(6 / steps["first"]["seconds"])


def test_a_worker_leaves_cores_to_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    before = cv2.getNumThreads()
    limit_threads(1)
    assert cv2.getNumThreads() == 1 and os.environ["OMP_NUM_THREADS"] == "1"
    cv2.setNumThreads(before)


def test_only_what_depends_on_a_change_runs_again(tmp_path: Path) -> None:
    finish(noting_plan(tmp_path, Source(2)))
    finish(noting_plan(tmp_path, Source(3)))
    assert len(runs(tmp_path)) == 6
    finish(noting_plan(tmp_path, Source(3, version="1")))
    assert len(runs(tmp_path)) == 12
    finish(noting_plan(tmp_path, Source(3), extra=1))
    assert len(runs(tmp_path)) == 18
    finish(noting_plan(tmp_path, Source(3)))
    assert len(runs(tmp_path)) == 18


def test_a_damaged_output_or_mark_is_made_again(tmp_path: Path) -> None:
    plan = noting_plan(tmp_path, Source(2))
    finish(plan)
    one, two = (EpisodeWork(plan, ref).output("clips") for ref in plan.source.episodes())
    os.truncate(one, 100)
    mark_path(two).write_text("{")
    finish(plan)
    assert sorted(runs(tmp_path)[4:]) == ["clips episode_000", "clips episode_001"]


def test_a_failing_item_is_quarantined_with_its_traceback_and_the_others_go_on(tmp_path: Path) -> None:
    plan = noting_plan(tmp_path, Source(4, broken=(1,)), fails="episode_002")
    summary = finish(plan)
    assert summary.done == 2
    broken, failing = summary.quarantined
    assert (broken["episode"], broken["stage"]) == ("episode_001", "first")
    assert broken["error"] == "video_1.mp4: truncated; copy it again"
    assert failing["error"] == "ValueError: no such colour" and "in __call__" in failing["traceback"]
    write_tables(plan, list(plan.source.episodes()), summary)
    rows = [json.loads(line) for line in (plan.folder / "quarantine.jsonl").read_text().splitlines()]
    assert rows == summary.quarantined
    assert json.loads((plan.folder / "summary.json").read_text())["quarantined"] == 2
    assert not list(tmp_path.rglob("*.tmp"))
    before = runs(tmp_path)
    finish(plan)
    assert runs(tmp_path) == before


def test_an_episode_that_kills_its_worker_is_tried_again_and_then_quarantined(tmp_path: Path) -> None:
    plan = noting_plan(tmp_path, Source(2), deadly="episode_001")
    summary = finish(plan, workers=1)
    assert summary.done == 1
    assert [(row["episode"], row["stage"]) for row in summary.quarantined] == [("episode_001", "first")]
    assert summary.quarantined[0]["error"].startswith("WorkerDied: 2 workers died over it")
    assert runs(tmp_path) == ["first episode_000", "clips episode_000", "first episode_001", "first episode_001"]


def test_a_full_disk_ends_the_run_with_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rsjax.tools.ingest.work_items.ArrayRecordWriter", full)
    with pytest.raises(UserError, match=r"disk is full"):
        finish(noting_plan(tmp_path, Source(2)))


def test_an_unfinished_ingest_is_not_counted(tmp_path: Path) -> None:
    plan = noting_plan(tmp_path, Source(2))
    with pytest.raises(UserError, match=r"not finished, run it again"):
        summarise(plan, list(plan.source.episodes()))
