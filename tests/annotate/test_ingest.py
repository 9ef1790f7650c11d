import errno
import hashlib
import json
import pickle
import re
import tracemalloc
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.annotate import packing
from rsjax.annotate.categories import CategoryConfig
from rsjax.annotate.clips import ClipConfig
from rsjax.annotate.ingest import LOCK, Plan, ingest
from rsjax.annotate.packing import split_episodes
from rsjax.annotate.protocols import AnnotationError
from rsjax.annotate.report import Counts, lines, tables
from rsjax.annotate.runner import Inline, Outcome
from rsjax.annotate.stages import Annotators, make_stages
from rsjax.annotate.units import Job, Unit
from rsjax.annotate.windows import WindowConfig
from rsjax.data.codec import Record
from rsjax.data.episode import Episode, EpisodeRef
from rsjax.data.lock import lock
from rsjax.data.store import Store, StoreError, decode_clip, open_store
from tests.annotate.toy import ByDepth, Relative, Source, episode

CONFIG = ClipConfig(
    WindowConfig(frames=4, rate=2), image_size=8, tracks=6, categories=CategoryConfig((("pick*", "simple"),))
)
NOTHING = Annotators(shots=None, motion=None, tracks=None, semantics=None)


def plan(folder: Path, source: Source, annotators: Annotators = NOTHING, share: float = 0.25) -> Plan:
    job = Job(source, "", make_stages(annotators, CONFIG), folder / "work")
    return Plan(job, folder / "store", share, {"config": {}})


def made(work: Plan, keep_clips: bool = False, retry: bool = False) -> Counts | None:
    counts = ingest(work, lambda: Inline(work.job), lambda done, total: None, keep_clips=keep_clips, retry=retry)
    if counts is not None:
        assert counts.found == counts.done + len(counts.filtered) + len(counts.quarantined)
    return counts


def episodes(store: Store, split: str) -> list[str]:
    source = store.source(split)
    return [source[i]["provenance"]["episode"] for i in range(len(source))]


def test_every_episode_is_a_clip_a_reason_or_a_row(tmp_path: Path) -> None:
    counts = made(plan(tmp_path, Source(8, broken=(1, 5), short=(2,), depth=True)))
    assert counts is not None
    assert (counts.found, counts.done) == (8, 5)
    short = "shorter than a window (4 frames at 2 Hz take 16 of 10 fps; the longest has 5): "
    assert counts.filtered == {"episode_002": f"{short}raise --windows.rate or lower --windows.frames"}
    assert [row["episode"] for row in counts.quarantined] == ["episode_001", "episode_005"]
    assert counts.windows == {"kept": 25}
    store = open_store(tmp_path / "store")
    assert sum(len(store.source(split)) for split in store.splits) == 25
    assert store.manifest["quarantine"]["episode_001"].startswith("clips: video_1.mp4")
    told = lines(counts)
    assert told[0] == "episodes  8 found = 5 with clips + 1 without + 2 quarantined"
    assert "quarantined episode_001 at clips: video_1.mp4: truncated; copy it again" in told
    assert "EpisodeError" in counts.quarantined[0]["traceback"]


def test_which_windows_are_left_out_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = ClipConfig(WindowConfig(frames=4, rate=2, least_motion=1e6), image_size=8, tracks=6)
    monkeypatch.setattr("tests.annotate.test_ingest.CONFIG", config)
    with pytest.raises(StoreError, match=r"first one for: windows left out: 5 still"):
        made(plan(tmp_path, Source(2), Annotators(shots=None)))
    rows = [json.loads(row) for row in (tmp_path / "work" / "windows.jsonl").read_text().splitlines()]
    assert rows == [{"episode": f"episode_{n:03d}", "left_out": {"still": [0, 5, 10, 15, 20]}} for n in range(2)]


def test_a_store_has_units_and_labels_that_training_reads(tmp_path: Path) -> None:
    made(plan(tmp_path, Source(6, depth=True)))
    store = open_store(tmp_path / "store")
    source = store.source("train")
    clips = [decode_clip(source[i]) for i in range(len(source))]
    rows = np.concatenate([clip.actions[1:] for clip in clips])
    np.testing.assert_allclose(store.manifest["action_mean"], rows.mean(0), rtol=1e-5)
    np.testing.assert_allclose(store.manifest["action_std"], rows.std(0), rtol=1e-5)
    low, high = store.manifest["depth_range"]
    depths = [clip.depth for clip in clips if clip.depth is not None]
    assert len(depths) == len(clips) and store.manifest["depth_unit"] == "metres"
    assert low == min(depth.min() for depth in depths) and high == max(depth.max() for depth in depths)
    assert all(clip.provenance["depth_range"] == [low, high] for clip in clips)
    labels = store.labels("train").counts()
    assert labels["difficulty"] == {"simple": len(clips)}
    assert set(labels["segment"]) == {"reach", "grasp"} and set(labels["skill"]) == {"unknown", "Grasp"}
    assert labels["skill"]["Grasp"] == sum(clip.provenance["skill"] == "Grasp" for clip in clips)


def test_no_episode_is_in_both_splits(tmp_path: Path) -> None:
    made(plan(tmp_path, Source(8)))
    store = open_store(tmp_path / "store")
    train, test = set(episodes(store, "train")), set(episodes(store, "test"))
    assert len(train) == 6 and len(test) == 2 and not train & test
    assert store.manifest["episodes"] == {"train": sorted(train), "test": sorted(test)}


@given(st.sets(st.text(), max_size=30), st.floats(0, 0.99))
def test_each_episode_is_in_one_split_and_both_have_some(names: set[str], share: float) -> None:
    refs = [EpisodeRef(name, "", {}) for name in sorted(names)]
    splits = split_episodes(refs, share)
    assert sorted(ref.id for part in splits.values() for ref in part) == sorted(names)
    if len(refs) >= 2 and share > 0:
        assert all(splits.values())


def test_the_same_again_does_nothing_and_more_episodes_reuse_annotations(tmp_path: Path) -> None:
    methods = Annotators()
    made(plan(tmp_path, Source(3), methods))
    assert made(plan(tmp_path, Source(3), methods)) is None
    work = plan(tmp_path, Source(4), methods)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("units/tracks/*/*")}
    counts = made(work)
    assert counts is not None and counts.done == 4 and len(before) == 6
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert not list((tmp_path / "work" / "units" / "clips").rglob("*.*"))


@pytest.mark.parametrize("keep_clips", [False, True])
def test_the_quarantined_are_tried_again_only_when_asked(tmp_path: Path, keep_clips: bool) -> None:
    made(plan(tmp_path, Source(3, broken=(1,))), keep_clips=keep_clips)
    work = plan(tmp_path, Source(3))
    assert made(work) is None
    more = made(plan(tmp_path, Source(4)), keep_clips=keep_clips)
    assert more is not None and [row["episode"] for row in more.quarantined] == ["episode_001"]
    counts = made(work, retry=True)
    assert counts is not None and counts.done == 3 and not counts.quarantined
    assert made(work, retry=True) is None


def test_all_stages_leave_what_clips_read(tmp_path: Path) -> None:
    work = plan(tmp_path, Source(2, depth=True), Annotators())
    counts = made(work, keep_clips=True)
    assert counts is not None and counts.done == 2
    assert list(counts.stages) == ["shots", "motion", "tracks", "semantics", "clips"]
    ref = next(work.job.source.episodes())
    unit = Unit(ref, "clips")
    clip = decode_clip(work.job.records(unit, work.job.mark(unit) or {})[0])
    assert clip.visible[:, 0].all() and clip.tracks.shape == (6, 4, 2)
    assert clip.provenance["segment"] == "reach" and "motion" in clip.provenance


@pytest.mark.parametrize(("deep", "unit"), [(1, "relative"), (5, "metres"), (6, "metres"), (0, "relative")])
def test_metres_and_relative_depth_are_not_mixed(tmp_path: Path, deep: int, unit: str) -> None:
    network = Annotators(None, None, Relative(), None, None)
    counts = made(plan(tmp_path, Source(6, deep=deep), network))
    store = open_store(tmp_path / "store")
    records = [store.source(split)[i] for split in store.splits for i in range(len(store.source(split)))]
    assert counts is not None and counts.done == 6 and len(records) == 30
    by_episode = {record["provenance"]["episode"] for record in records if record["depth"] is not None}
    assert by_episode == {f"episode_{n:03d}" for n in range(6) if (n < deep) == (unit == "metres")}
    for record in records:
        assert record["provenance"]["depth_unit"] == (unit if record["depth"] is not None else "")
        assert record["provenance"]["depth_range"] == store.manifest["depth_range"]
    assert store.manifest["depth_unit"] == unit
    assert store.manifest["depth_range"] == ([3.0, 3.0] if unit == "relative" else pytest.approx([1.0, 4.5]))
    assert counts.depth_left_out == store.manifest["counts"]["depth_left_out"] == 5 * (6 - len(by_episode))
    told = f"depth     left out of {counts.depth_left_out} clips"
    assert any(line.startswith(told) for line in lines(counts)) == (deep in (1, 5))


def test_where_only_the_test_split_has_depth_none_is_kept(tmp_path: Path) -> None:
    source = Source(4)
    held = split_episodes(list(source.episodes()), 0.25)["test"][0]
    counts = made(plan(tmp_path, Source(4, only=held.location["number"])))
    store = open_store(tmp_path / "store")
    assert store.manifest["depth_range"] is None and store.manifest["depth_unit"] is None
    assert counts is not None and counts.depth_left_out == 5 and store.source("test")[0]["depth"] is None


def test_a_network_that_cannot_be_loaded_ends_the_job_and_quarantines_nothing(tmp_path: Path) -> None:
    work = plan(tmp_path, Source(2), Annotators(None, None, Relative(there=False), None, None))
    with pytest.raises(AnnotationError, match=r"relative.pt: no such file"):
        made(work)
    assert not list(tmp_path.rglob("units/**/*.json"))


def test_a_network_that_tracks_sees_recorded_depth_or_else_that_of_the_stage(tmp_path: Path) -> None:
    methods = Annotators(None, None, Relative(), ByDepth(), None)  # type: ignore[arg-type]
    made(plan(tmp_path, Source(2, deep=1), methods, share=0.0))
    source = open_store(tmp_path / "store").source("train")
    for number in range(len(source)):
        record = source[number]
        frames = np.array(record["provenance"]["frames"])
        deep = record["provenance"]["episode"] == "episode_000"
        np.testing.assert_allclose(record["tracks"][0, :, 0], 0.1 + frames / 100 if deep else 0.3, atol=1e-3)


@dataclass
class Odd(Source):
    """Its last episode has another action, and one is listed twice."""

    def episodes(self) -> list[EpisodeRef]:  # type: ignore[override]
        refs = list(super().episodes())
        return [*refs, EpisodeRef(refs[0].id, "f" * 16, refs[0].location)]

    def read(self, ref: EpisodeRef) -> Episode:
        if ref.location["number"] == self.count - 1:
            return episode(ref.id, actions=np.zeros((40, 5), np.float32), fingerprint=ref.fingerprint)
        return super().read(ref)


def test_episodes_that_do_not_fit_the_others_are_rows(tmp_path: Path) -> None:
    counts = made(plan(tmp_path, Odd(4)))
    assert counts is not None and (counts.found, counts.done) == (5, 3)
    errors = {row["episode"]: row["error"] for row in counts.quarantined}
    assert errors["episode_003"] == "actions: 5 dimensions, those of most others have 2; ingest it alone"
    assert "another episode is called episode_000" in errors["episode_000"]


def test_a_manifest_tells_of_all_that_is_quarantined_under_one_name(tmp_path: Path) -> None:
    made(plan(tmp_path, Odd(5, broken=(0,))))
    manifest = open_store(tmp_path / "store").manifest
    assert "video_0.mp4: truncated" in manifest["quarantine"]["episode_000"]
    assert "another episode is called episode_000" in manifest["quarantine"]["episode_000"]
    counts = manifest["counts"]
    assert counts["found"] == counts["done"] + counts["without"] + counts["quarantined"] == 6
    assert counts["quarantined"] == 3


def test_the_first_episode_does_not_say_how_long_actions_are(tmp_path: Path) -> None:
    class First(Source):
        def read(self, ref: EpisodeRef) -> Episode:
            width = 5 if ref.location["number"] == 0 else 2
            return episode(ref.id, actions=np.zeros((40, width), np.float32), fingerprint=ref.fingerprint)

    counts = made(plan(tmp_path, First(4)))
    assert counts is not None and [row["episode"] for row in counts.quarantined] == ["episode_000"]


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
def test_an_option_for_which_all_are_quarantined_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, config: ClipConfig, told: str
) -> None:
    monkeypatch.setattr("tests.annotate.test_ingest.CONFIG", config)
    with pytest.raises(StoreError, match=re.escape(told)):
        made(plan(tmp_path, Source(3)))
    monkeypatch.undo()
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


def test_memory_does_not_grow_with_the_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def peak(count: int) -> int:
        work = plan(tmp_path / str(count), Source(count, depth=True))
        tracemalloc.start()
        made(work)
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    config = ClipConfig(CONFIG.windows, image_size=96, tracks=6)  # 440 kB of pixels a clip, 5 clips an episode
    monkeypatch.setattr("tests.annotate.test_ingest.CONFIG", config)
    peak(1)
    few, many = peak(3), peak(12)
    assert many < few + 1_000_000  # the pixels of nine more episodes are 20 MB


def test_what_workers_are_told_and_tell_is_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    monkeypatch.setattr("tests.annotate.test_ingest.CONFIG", config)
    work = plan(tmp_path, Source(2, depth=True), Annotators())
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
    with pytest.raises(StoreError, match=r"disk is full"):
        made(plan(tmp_path, Source(3)))
    assert hashlib.sha256((tmp_path / "store" / "manifest.json").read_bytes()).digest() == before


def test_a_loop_of_links_in_place_of_the_store_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "store").symlink_to("store")
    with pytest.raises(StoreError, match=r"store: cannot write"):
        made(plan(tmp_path, Source(2)))
