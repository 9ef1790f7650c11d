import errno
import hashlib
import tracemalloc
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.annotate import ingest as ingest_module
from rsjax.annotate.categories import CategoryConfig
from rsjax.annotate.clips import ClipConfig
from rsjax.annotate.ingest import Plan, ingest, split_episodes
from rsjax.annotate.report import lines
from rsjax.annotate.runner import Counts, Inline
from rsjax.annotate.stages import Annotators, make_stages
from rsjax.annotate.units import Job, Unit
from rsjax.annotate.windows import WindowConfig
from rsjax.data.codec import Record
from rsjax.data.episode import Episode, EpisodeRef
from rsjax.data.store import Store, StoreError, decode_clip, open_store
from tests.annotate.toy import Source, episode

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
    assert counts.filtered == {"episode_002": "shorter than a window"}
    assert [row["episode"] for row in counts.quarantined] == ["episode_001", "episode_005"]
    assert counts.windows == {"kept": 25}
    store = open_store(tmp_path / "store")
    assert sum(len(store.source(split)) for split in store.splits) == 25
    assert store.manifest["quarantine"]["episode_001"].startswith("clips: EpisodeError: video_1.mp4")
    told = lines(counts)
    assert told[0] == "episodes 8 found = 5 with clips + 1 without + 2 quarantined"
    assert any(line.startswith("quarantined episode_001 at clips: ") for line in told)


def test_a_store_has_units_and_labels_that_training_reads(tmp_path: Path) -> None:
    made(plan(tmp_path, Source(6, depth=True)))
    store = open_store(tmp_path / "store")
    source = store.source("train")
    clips = [decode_clip(source[i]) for i in range(len(source))]
    rows = np.concatenate([clip.actions[1:] for clip in clips])
    np.testing.assert_allclose(store.manifest["action_mean"], rows.mean(0), rtol=1e-5)
    np.testing.assert_allclose(store.manifest["action_std"], rows.std(0), rtol=1e-5)
    low, high = store.manifest["depth_range"]
    assert low == min(clip.depth.min() for clip in clips) and high == max(clip.depth.max() for clip in clips)
    assert all(clip.provenance["depth_range"] == [low, high] for clip in clips)
    assert store.labels("train").counts()["difficulty"] == {"simple": len(clips)}


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
    assert not (tmp_path / "work" / "units" / "clips").exists()


def test_the_quarantined_are_tried_again_only_when_asked(tmp_path: Path) -> None:
    made(plan(tmp_path, Source(3, broken=(1,))), keep_clips=True)
    work = plan(tmp_path, Source(3))
    assert made(work) is None
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
    assert errors["episode_003"] == "actions: 5 dimensions, those of the others have 2; ingest it alone"
    assert "another episode is called episode_000" in errors["episode_000"]


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


@pytest.mark.parametrize(
    ("source", "match"),
    [
        (Source(0), r"the toy data set has no episode"),
        (
            Source(2, broken=(0,), short=(1,)),
            r"none of 2 episodes gave a clip \(1 left out, 1 not readable\).*video_0.mp4: truncated",
        ),
    ],
)
def test_where_nothing_comes_of_it_one_line_says_so(tmp_path: Path, source: Source, match: str) -> None:
    with pytest.raises(StoreError, match=match):
        made(plan(tmp_path, source))
    assert not (tmp_path / "store").exists()


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
    few, many = peak(2), peak(12)
    assert many < few + 1_000_000


def test_a_failed_packing_leaves_the_old_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made(plan(tmp_path, Source(2)))
    before = hashlib.sha256((tmp_path / "store" / "manifest.json").read_bytes()).digest()

    def failing(*arguments: object) -> Iterator[Record]:
        raise OSError(errno.ENOSPC, "No space left on device")
        yield {}

    monkeypatch.setattr(ingest_module, "_records", failing)
    with pytest.raises(StoreError, match=r"disk is full"):
        made(plan(tmp_path, Source(3)))
    assert hashlib.sha256((tmp_path / "store" / "manifest.json").read_bytes()).digest() == before


def test_a_loop_of_links_in_place_of_the_store_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "store").symlink_to("store")
    with pytest.raises(StoreError, match=r"store: cannot write"):
        made(plan(tmp_path, Source(2)))
