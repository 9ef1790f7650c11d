import errno
import hashlib
import json
import os
import pickle
import tracemalloc
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from rsjax.data.store import StoreError
from rsjax.files import FileError, making
from rsjax.tools.ingest.annotate import Annotators
from rsjax.tools.ingest.clips import ClipConfig
from rsjax.tools.ingest.episode import EpisodeRef
from rsjax.tools.ingest.ingest import ingest
from rsjax.tools.ingest.windows import WindowConfig
from rsjax.tools.ingest.work_items import EpisodeWork, run_episode, run_item
from tests.tools.ingest.toy import CONFIG, Source, clip_plan, ingested


@dataclass
class Hostile(Source):
    """Ids that are paths."""

    def episodes(self) -> Sequence[EpisodeRef]:  # type: ignore[override]
        return [
            EpisodeRef(name, "0" * 16, {"number": 0}) for name in ("../../escaped", "/tmp/x", "..", "a\0b", "x" * 300)
        ]


def test_an_id_leads_nowhere_but_into_the_folder(tmp_path: Path) -> None:
    summary = ingested(clip_plan(tmp_path / "inner", Hostile(0)))
    assert summary is not None and summary.done == 5
    assert [path.name for path in tmp_path.iterdir()] == ["inner"]
    assert sorted(path.name for path in (tmp_path / "inner").iterdir()) == [".store.lock", "store", "store.work"]


def test_what_is_no_store_of_this_data_set_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "thesis.txt").write_text("years of work")
    with pytest.raises(StoreError, match=r"exists and is not a store"):
        ingested(clip_plan(tmp_path, Source(2)))
    ingested(clip_plan(tmp_path / "inner", Source(2)))
    with pytest.raises(StoreError, match=r"holds clips of toy, not what this makes of other"):
        ingested(clip_plan(tmp_path / "inner", Source(2, name="other")))
    manifest = tmp_path / "inner" / "store" / "manifest.json"
    merged = {name: value for name, value in json.loads(manifest.read_text()).items() if name != "counts"}
    manifest.write_text(json.dumps(merged))
    with pytest.raises(StoreError, match=r"holds clips of toy, not what this makes of toy"):
        ingested(clip_plan(tmp_path / "inner", Source(3)))
    assert not (tmp_path / "store.work").exists()


def test_two_that_make_one_store_do_not_meet(tmp_path: Path) -> None:
    plan = clip_plan(tmp_path, Source(2))
    with (
        making(plan.out, wait=False),
        pytest.raises(FileError, match=rf"store: process {os.getpid()} on .* is making it"),
    ):
        ingested(plan)
    left = plan.items / "tracks" / "ab" / "x.array_record.host-1.tmp"  # as a killed worker leaves it
    left.parent.mkdir(parents=True)
    left.touch()
    summary = ingested(plan)
    assert summary is not None and summary.tables() == "" and not left.exists()


NONE = r"none of 2 episodes gave a clip"


@pytest.mark.parametrize(
    ("source", "changes", "match"),
    [
        (Source(0), {}, r"the toy data set has no episode"),
        (Source(2, short=(0, 1)), {}, rf"{NONE} .*the longest has 5\).* has all of them in summary.json$"),
        (
            Source(2, (0,), (1,)),
            {},
            rf"{NONE} \(1 left out, 1 quara.*video_0.mp4: trunc.*summary.json and quarantine.json",
        ),
        (Source(2), {"camera": "fronty"}, rf"{NONE} .*2 quarantined, all 2 .* of --camera\).* in quarantine.jsonl$"),
        (Source(2), {"windows": WindowConfig(4, 20)}, rf"{NONE} .* because of --windows.rate\)"),
    ],
)
def test_where_nothing_comes_of_it_one_line_says_so(
    tmp_path: Path, source: Source, changes: dict[str, Any], match: str
) -> None:
    with pytest.raises(StoreError, match=match):
        ingested(clip_plan(tmp_path, source, config=replace(CONFIG, **changes)))
    assert not (tmp_path / "store").exists()


def test_a_manifest_is_json_for_others_too(tmp_path: Path) -> None:
    config = {"most": float("inf"), "deep": [{"x": float("nan")}], "y": 1.5}
    ingested(replace(clip_plan(tmp_path, Source(2)), meta={"config": config}))

    def refuse(word: str) -> None:
        raise AssertionError(word)

    manifest = json.loads((tmp_path / "store" / "manifest.json").read_text(), parse_constant=refuse)
    assert manifest["config"] == {"most": None, "deep": [{"x": None}], "y": 1.5}


def test_memory_does_not_grow_with_the_episodes(tmp_path: Path) -> None:
    config = ClipConfig(CONFIG.windows, image_size=96, tracks=6)  # 440 kB of pixels a clip, 5 clips an episode

    def peak(count: int) -> int:
        plan = clip_plan(tmp_path / str(count), Source(count, deep=range(count)), config=config)
        tracemalloc.start()
        ingested(plan)
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    peak(1)
    few = peak(3)
    many = peak(8)
    assert many < few + 1_000_000  # the pixels of five more episodes are 11 MB


def test_messages_to_and_from_workers_are_small(tmp_path: Path) -> None:
    """Ids and places, never pictures."""
    plan = clip_plan(tmp_path, Source(2, deep=range(2)), Annotators(), config=replace(CONFIG, image_size=96))
    for ref in plan.source.episodes():
        work = EpisodeWork(plan, ref)
        marks = [run_item(work, step, set()) for step in plan.steps]
        assert len(work.records("clips", marks[-1]["records"])[0]["rgb"].tobytes()) > 100_000
        messages = [ref, run_episode(plan, ref, set()), *marks]  # those of the pool and of Ray
        assert max(len(pickle.dumps(message)) for message in messages) < 2000


def test_a_failed_packing_leaves_the_old_store(tmp_path: Path) -> None:
    ingested(clip_plan(tmp_path, Source(2)))
    before = hashlib.sha256((tmp_path / "store" / "manifest.json").read_bytes()).digest()

    def fill_the_disk(done: int, total: int) -> None:
        if done == total:  # all clips are written, but not the manifest
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(FileError, match=r"disk is full"):
        ingest(clip_plan(tmp_path, Source(3)), progress=fill_the_disk)
    assert hashlib.sha256((tmp_path / "store" / "manifest.json").read_bytes()).digest() == before


def test_a_loop_of_links_in_place_of_the_store_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "store").symlink_to("store")
    with pytest.raises(FileError, match=r"store: cannot write"):
        ingested(clip_plan(tmp_path, Source(2)))
