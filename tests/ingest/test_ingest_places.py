import errno
import hashlib
import json
import pickle
import re
import tracemalloc
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from rsjax.data.codec import Record
from rsjax.data.store import StoreError, open_store
from rsjax.files import FileError, lock
from rsjax.ingest import packing
from rsjax.ingest.clips import ClipConfig
from rsjax.ingest.episode import EpisodeRef
from rsjax.ingest.ingest import LOCK, Plan, ingest
from rsjax.ingest.jobs.runner import Inline, Outcome
from rsjax.ingest.jobs.work_items import Unit
from rsjax.ingest.report import tables
from rsjax.ingest.stages import Annotators
from rsjax.ingest.windows import WindowConfig
from tests.ingest.ingesting import CONFIG, made, plan
from tests.ingest.toy import Source


@dataclass
class Hostile(Source):
    """Ids that are paths."""

    def episodes(self) -> Sequence[EpisodeRef]:  # type: ignore[override]
        return [
            EpisodeRef(name, "0" * 16, {"number": 0}) for name in ("../../escaped", "/tmp/x", "..", "a\0b", "x" * 300)
        ]


def test_an_id_leads_nowhere_but_into_the_folder(tmp_path: Path) -> None:
    counts = made(plan(tmp_path / "inner", Hostile(0)))
    assert counts is not None and counts.done == 5
    assert [path.name for path in tmp_path.iterdir()] == ["inner"]
    assert sorted(path.name for path in (tmp_path / "inner").iterdir()) == ["store", "work"]


def test_what_is_no_store_of_this_data_set_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "thesis.txt").write_text("years of work")
    with pytest.raises(StoreError, match=r"exists and is not a store"):
        made(plan(tmp_path, Source(2)))
    made(plan(tmp_path / "inner", Source(2)))
    with pytest.raises(StoreError, match=r"holds clips of toy, not what this makes of other"):
        made(plan(tmp_path / "inner", Source(2, name="other")))
    manifest = tmp_path / "inner" / "store" / "manifest.json"
    merged = {name: value for name, value in json.loads(manifest.read_text()).items() if name != "counts"}
    manifest.write_text(json.dumps(merged))
    with pytest.raises(StoreError, match=r"holds clips of toy, not what this makes of toy"):
        made(plan(tmp_path / "inner", Source(3)))
    assert not (tmp_path / "work").exists()


def test_two_that_make_one_store_do_not_meet(tmp_path: Path) -> None:
    work = plan(tmp_path, Source(2))
    with lock(work.job.folder / LOCK), pytest.raises(StoreError, match=r"another process is making it"):
        made(work)
    assert made(work) is not None


def test_what_a_killed_worker_left_is_swept_up(tmp_path: Path) -> None:
    left = tmp_path / "work" / "units" / "tracks" / "ab" / "x.array_record.host-1.tmp"
    left.parent.mkdir(parents=True)
    left.touch()
    made(plan(tmp_path, Source(2)))
    assert not left.exists()


@pytest.mark.parametrize(
    ("source", "match"),
    [
        (Source(0), r"the toy data set has no episode"),
        (
            Source(2, broken=(0,), short=(1,)),
            r"none of 2 episodes gave a clip \(1 left out, 1 quarantined\).*video_0.mp4: truncated",
        ),
    ],
)
def test_where_nothing_comes_of_it_one_line_says_so(tmp_path: Path, source: Source, match: str) -> None:
    with pytest.raises(StoreError, match=match):
        made(plan(tmp_path, source))
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize(
    ("config", "told"),
    [
        (
            ClipConfig(CONFIG.windows, 8, 6, camera="fronty"),
            "(0 left out, 3 quarantined, all 3 of these because of --camera)",
        ),
        (
            ClipConfig(WindowConfig(4, 20), 8, 6),
            "(0 left out, 3 quarantined, all 3 of these because of --windows.rate)",
        ),
    ],
)
def test_an_option_for_which_all_are_quarantined_is_named(tmp_path: Path, config: ClipConfig, told: str) -> None:
    with pytest.raises(StoreError, match=re.escape(told)):
        made(plan(tmp_path, Source(3), config=config))
    with pytest.raises(StoreError, match=r"\(0 left out, 2 quarantined\), the first"):
        made(plan(tmp_path, Source(2, broken=(0, 1))))


def test_only_tables_that_hold_something_are_named(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"the longest has 5\).* has all of them in summary.json$"):
        made(plan(tmp_path, Source(2, short=(0, 1))))
    with pytest.raises(StoreError, match=r" has all of them in quarantine.jsonl$"):
        made(plan(tmp_path / "broken", Source(2, broken=(0, 1))))
    counts = made(plan(tmp_path / "sound", Source(2)))
    assert counts is not None and tables(counts) == ""


def test_a_manifest_is_json_for_others_too(tmp_path: Path) -> None:
    work = plan(tmp_path, Source(2))
    made(Plan(work.job, work.out, 0.25, {"config": {"most": float("inf"), "deep": [{"x": float("nan")}], "y": 1.5}}))

    def refuse(word: str) -> None:
        raise AssertionError(word)

    manifest = json.loads((tmp_path / "store" / "manifest.json").read_text(), parse_constant=refuse)
    assert manifest["config"] == {"most": None, "deep": [{"x": None}], "y": 1.5}


def test_memory_does_not_grow_with_the_episodes(tmp_path: Path) -> None:
    config = ClipConfig(CONFIG.windows, image_size=96, tracks=6)  # 440 kB of pixels a clip, 5 clips an episode

    def peak(count: int) -> int:
        work = plan(tmp_path / str(count), Source(count, depth=True), config=config)
        tracemalloc.start()
        made(work)
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    peak(1)
    few, many = peak(3), peak(12)
    assert many < few + 1_000_000  # the pixels of nine more episodes are 20 MB


def test_what_workers_are_told_and_tell_is_small(tmp_path: Path) -> None:
    """Ids and places, never pictures: all that an executor is given and gives, pickled."""
    sent: list[int] = []

    class Recording(Inline):
        def submit(self, unit: Unit) -> None:
            sent.append(len(pickle.dumps(unit)))
            super().submit(unit)

        def wait(self) -> list[Outcome]:
            outcomes = super().wait()
            sent.append(len(pickle.dumps(outcomes)))
            return outcomes

    config = ClipConfig(CONFIG.windows, image_size=96, tracks=6)
    work = plan(tmp_path, Source(2, depth=True), Annotators(), config=config)
    ingest(work, lambda: Recording(work.job), lambda done, total: None, keep_clips=True)
    assert len(sent) == 20 and max(sent) < 2000
    assert all(len(record["rgb"].tobytes()) > 100_000 for record in [open_store(work.out).source("train")[0]])


def test_a_failed_packing_leaves_the_old_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made(plan(tmp_path, Source(2)))
    before = hashlib.sha256((tmp_path / "store" / "manifest.json").read_bytes()).digest()

    def failing(*arguments: object) -> Iterator[Record]:
        raise OSError(errno.ENOSPC, "No space left on device")
        yield {}

    monkeypatch.setattr(packing, "_records", failing)
    with pytest.raises(FileError, match=r"disk is full"):
        made(plan(tmp_path, Source(3)))
    assert hashlib.sha256((tmp_path / "store" / "manifest.json").read_bytes()).digest() == before


def test_a_loop_of_links_in_place_of_the_store_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "store").symlink_to("store")
    with pytest.raises(FileError, match=r"store: cannot write"):
        made(plan(tmp_path, Source(2)))
