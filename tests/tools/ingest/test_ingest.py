import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.clip import Clip
from rsjax.data.store import Store, StoreError, open_store
from rsjax.tools.ingest.annotate import Annotators
from rsjax.tools.ingest.annotators.protocols import AnnotationError
from rsjax.tools.ingest.clips import ClipConfig
from rsjax.tools.ingest.episode import Episode, EpisodeRef
from rsjax.tools.ingest.packing import split_episodes
from rsjax.tools.ingest.summary import IngestSummary, lines
from rsjax.tools.ingest.windows import WindowConfig
from rsjax.tools.ingest.work_items import SplitShares
from tests.tools.ingest.toy import CONFIG, ByDepth, Relative, Source, clip_plan, episode, ingested


def episodes(store: Store, split: str) -> list[str]:
    source = store.source(split)
    return [source[i]["provenance"]["episode"] for i in range(len(source))]


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> tuple[IngestSummary, Store]:
    """Eight episodes with depth, of which two cannot be read and one is too short."""
    plan = clip_plan(tmp_path_factory.mktemp("mixed"), Source(8, broken=(1, 5), short=(2,), deep=range(8)))
    summary = ingested(plan)
    assert summary is not None
    return summary, open_store(plan.out)


def test_every_episode_is_a_clip_a_reason_or_a_row(mixed: tuple[IngestSummary, Store]) -> None:
    summary, store = mixed
    assert (summary.episodes, summary.done) == (8, 5)
    short = "shorter than a window (4 frames at 2 Hz take 16 of 10 fps; the longest has 5): "
    assert summary.filtered == {"episode_002": f"{short}raise --windows.rate or lower --windows.frames"}
    assert [row["episode"] for row in summary.quarantined] == ["episode_001", "episode_005"]
    assert summary.windows == {"kept": 25}
    assert sum(len(store.source(split)) for split in store.splits) == 25
    assert store.manifest["quarantine"]["episode_001"].startswith("clips: video_1.mp4")
    assert store.manifest["success_share"] is None  # no episode says whether it succeeded
    text = lines(summary)
    assert text[0] == "episodes  8 = 5 with clips + 1 without + 2 quarantined"
    assert not any("left out of" in line for line in text)
    assert "quarantined episode_001 at clips: video_1.mp4: truncated; copy it again" in text
    assert "EpisodeError" in summary.quarantined[0]["traceback"]


def test_which_windows_are_left_out_is_kept(tmp_path: Path) -> None:
    config = ClipConfig(WindowConfig(frames=4, rate=2, least_motion=1e6), image_size=8, tracks=6)
    with pytest.raises(StoreError, match=r"first one for: windows left out: 5 still"):
        ingested(clip_plan(tmp_path, Source(2), Annotators(shots=None), config=config))
    rows = [json.loads(row) for row in (tmp_path / "store.work" / "windows.jsonl").read_text().splitlines()]
    assert rows == [{"episode": f"episode_{n:03d}", "left_out": {"still": [0, 5, 10, 15, 20]}} for n in range(2)]


def test_a_store_has_statistics_and_labels_that_training_reads(mixed: tuple[IngestSummary, Store]) -> None:
    _, store = mixed
    source = store.source("train")
    clips = [Clip(**source[i]) for i in range(len(source))]
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


def test_no_episode_is_in_both_splits(mixed: tuple[IngestSummary, Store]) -> None:
    _, store = mixed
    train = set(episodes(store, "train"))
    test = set(episodes(store, "test"))
    assert len(train) == 4 and len(test) == 1 and not train & test
    assert store.manifest["episodes"] == {"train": sorted(train), "test": sorted(test)}


@settings(max_examples=30)
@given(st.sets(st.text(max_size=8), max_size=12), st.floats(0, 0.99))
def test_each_episode_is_in_one_split_and_both_have_some(names: set[str], share: float) -> None:
    refs = [EpisodeRef(name, "", {}) for name in sorted(names)]
    splits = split_episodes(refs, SplitShares(share))
    assert sorted(ref.id for part in splits.values() for ref in part) == sorted(names)
    if len(refs) >= 2 and share > 0:
        assert all(splits.values())


def test_validation_is_taken_from_the_train_split_and_a_seed_chooses_others() -> None:
    refs = [EpisodeRef(f"{number}", "", {}) for number in range(20)]
    splits = split_episodes(refs, SplitShares(0.2, 0.1, seed=1))
    assert {split: len(part) for split, part in splits.items()} == {"train": 14, "test": 4, "validation": 2}
    assert sorted(ref.id for part in splits.values() for ref in part) == sorted(ref.id for ref in refs)
    again = [split_episodes(refs, SplitShares(0.2, 0.1, seed))["test"] for seed in (1, 2)]
    assert again[0] == splits["test"] != again[1]


@settings(max_examples=30)
@given(st.lists(st.sampled_from(["train", "test", "cameras"]), min_size=2, max_size=9), st.floats(0, 0.99))
def test_clips_of_a_store_stay_on_their_side(sides: list[str], share: float) -> None:
    refs = [EpisodeRef(f"{side}-{number}", "", {"split": side}) for number, side in enumerate(sides)]
    splits = split_episodes(refs, SplitShares(share))
    if 0 < sides.count("train") < len(sides):
        assert {ref.id for ref in splits["train"]} == {ref.id for ref in refs if ref.id.startswith("train")}
    assert sorted(ref.id for part in splits.values() for ref in part) == sorted(ref.id for ref in refs)


def test_the_same_again_does_nothing_and_more_episodes_reuse_annotations(tmp_path: Path) -> None:
    methods = Annotators()
    summary = ingested(clip_plan(tmp_path, Source(3, deep=range(3)), methods))
    assert summary is not None and list(summary.steps) == ["shots", "motion", "tracks", "semantics", "clips"]
    clip = Clip(**open_store(tmp_path / "store").source("train")[0])
    assert clip.visible[:, 0].all() and clip.tracks.shape == (6, 4, 2)
    assert clip.provenance["segment"] == "reach" and "motion" in clip.provenance
    assert ingested(clip_plan(tmp_path, Source(3, deep=range(3)), methods)) is None
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("items/tracks/*/*")}
    summary = ingested(clip_plan(tmp_path, Source(4, deep=range(4)), methods))
    assert summary is not None and summary.done == 4 and len(before) == 6
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert not list((tmp_path / "store.work" / "items" / "clips").rglob("*.*"))


@pytest.mark.parametrize("keep_clips", [False, True])
def test_the_quarantined_are_tried_again_only_when_asked(tmp_path: Path, keep_clips: bool) -> None:
    ingested(clip_plan(tmp_path, Source(3, broken=(1,))), keep_clips=keep_clips)
    plan = clip_plan(tmp_path, Source(3))
    assert ingested(plan) is None
    more = ingested(clip_plan(tmp_path, Source(4)), keep_clips=keep_clips)
    assert more is not None and [row["episode"] for row in more.quarantined] == ["episode_001"]
    summary = ingested(plan, retry=True)
    assert summary is not None and summary.done == 3 and not summary.quarantined
    assert ingested(plan, retry=True) is None


@pytest.mark.parametrize(("deep", "unit"), [(1, "relative"), (5, "metres")])
def test_metres_and_relative_depth_are_not_mixed(tmp_path: Path, deep: int, unit: str) -> None:
    network = Annotators(None, None, Relative(), None, None)
    summary = ingested(clip_plan(tmp_path, Source(6, deep=range(deep)), network))
    store = open_store(tmp_path / "store")
    records = [store.source(split)[i] for split in store.splits for i in range(len(store.source(split)))]
    assert summary is not None and summary.done == 6 and len(records) == 30
    by_episode = {record["provenance"]["episode"] for record in records if record["depth"] is not None}
    assert by_episode == {f"episode_{n:03d}" for n in range(6) if (n < deep) == (unit == "metres")}
    for record in records:
        assert record["provenance"]["depth_unit"] == (unit if record["depth"] is not None else "")
        assert record["provenance"]["depth_range"] == store.manifest["depth_range"]
    assert store.manifest["depth_unit"] == unit
    assert store.manifest["depth_range"] == ([3.0, 3.0] if unit == "relative" else pytest.approx([1.0, 4.5]))
    assert summary.depth_left_out == store.manifest["counts"]["depth_left_out"] == 5 * (6 - len(by_episode))
    assert any(text.startswith("depth     left out of 5 clips") for text in lines(summary))


def test_where_only_the_test_split_has_depth_none_is_kept(tmp_path: Path) -> None:
    source = Source(4)
    test = split_episodes(list(source.episodes()), SplitShares(0.25))["test"][0]
    summary = ingested(clip_plan(tmp_path, Source(4, deep=[test.location["number"]])))
    store = open_store(tmp_path / "store")
    assert store.manifest["depth_range"] is None and store.manifest["depth_unit"] is None
    assert summary is not None and summary.depth_left_out == 5 and store.source("test")[0]["depth"] is None


def test_a_network_that_cannot_be_loaded_ends_the_ingest_and_quarantines_nothing(tmp_path: Path) -> None:
    plan = clip_plan(tmp_path, Source(2), Annotators(None, None, Relative(loads=False), None, None))
    with pytest.raises(AnnotationError, match=r"relative.pt: no such file"):
        ingested(plan)
    assert not list(tmp_path.rglob("items/**/*.json"))


def test_a_network_that_tracks_sees_recorded_depth_or_else_that_of_the_step(tmp_path: Path) -> None:
    methods = Annotators(None, None, Relative(), ByDepth(), None)  # type: ignore[arg-type]
    config = replace(CONFIG, fit="stretch")
    ingested(clip_plan(tmp_path, Source(2, deep=[0]), methods, share=0.0, config=config))
    source = open_store(tmp_path / "store").source("train")
    for number in range(len(source)):
        record = source[number]
        frames = np.array(record["provenance"]["frames"])
        deep = record["provenance"]["episode"] == "episode_000"
        np.testing.assert_allclose(record["tracks"][0, :, 0], 0.1 + frames / 100 if deep else 0.3, atol=1e-3)


@dataclass
class Odd(Source):
    """The first one that can be read has another action, and one that cannot is listed twice."""

    def episodes(self) -> list[EpisodeRef]:  # type: ignore[override]
        refs = list(super().episodes())
        return [*refs, EpisodeRef(refs[0].id, "f" * 16, refs[0].location)]

    def read(self, ref: EpisodeRef) -> Episode:
        if ref.location["number"] == 1:
            return episode(ref.id, actions=np.zeros((40, 5), np.float32), fingerprint=ref.fingerprint)
        return super().read(ref)


def test_episodes_that_do_not_fit_the_others_are_rows(tmp_path: Path) -> None:
    summary = ingested(clip_plan(tmp_path, Odd(5, broken=(0,))))
    assert summary is not None and (summary.episodes, summary.done, len(summary.quarantined)) == (6, 3, 3)
    manifest = open_store(tmp_path / "store").manifest
    reasons = manifest["quarantine"]
    assert reasons["episode_001"] == "list: actions: 5 dimensions, those of most others have 2; ingest it alone"
    # all that is quarantined under one name
    assert "video_0.mp4: truncated" in reasons["episode_000"]
    assert "another episode is called episode_000" in reasons["episode_000"]
    counts = manifest["counts"]
    assert (counts["found"], counts["done"], counts["without"], counts["quarantined"]) == (6, 3, 0, 3)


@pytest.mark.parametrize(("labelled", "share"), [(4, 1.0), (3, None)])
def test_the_share_of_success_is_known_if_every_episode_has_labels(
    tmp_path: Path, labelled: int, share: float | None
) -> None:
    class Labelled(Source):
        def read(self, ref: EpisodeRef) -> Episode:
            meta: dict[str, bool] = {}
            if ref.location["number"] < labelled:
                meta = {"success": True}
            return episode(ref.id, fingerprint=ref.fingerprint, meta=meta)

    ingested(clip_plan(tmp_path, Labelled(4)))
    assert open_store(tmp_path / "store").manifest["success_share"] == share
