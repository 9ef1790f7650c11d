from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.clip import Clip
from rsjax.data.build import clip_labels
from rsjax.data.codec import Record
from rsjax.tools.ingest.actions import ActionConfig
from rsjax.tools.ingest.annotate import Annotated
from rsjax.tools.ingest.annotators.categories import CategoryConfig
from rsjax.tools.ingest.clips import ClipConfig, cut
from rsjax.tools.ingest.episode import Episode, EpisodeError, Segment
from rsjax.tools.ingest.windows import WindowConfig
from tests.tools.ingest.toy import Pictures, episode

CONFIG = ClipConfig(WindowConfig(frames=4, rate=2), image_size=8, tracks=6)
STRETCHED = replace(CONFIG, fit="stretch")


class Records(list):
    """Records in memory, in place of a :class:`rsjax.data.store.Source`."""


def clips(made: Episode, config: ClipConfig = CONFIG, **annotations: Any) -> tuple[list[Record], dict[str, Any]]:
    generator = cut(Annotated(made, task=made.task, segments=made.segments, **annotations), config)
    kept = []
    while True:
        try:
            kept.append(next(generator))
        except StopIteration as stop:
            return kept, stop.value


def test_pictures_depth_and_actions_are_those_of_the_windows_frames() -> None:
    kept, summary = clips(
        episode("a", depth=True), ClipConfig(CONFIG.windows, 8, 6, actions=ActionConfig(compose="last"))
    )
    assert summary["windows"] == {"kept": 5} and len(kept) == 5
    for number, record in enumerate(kept):
        frames = np.array([0, 5, 10, 15]) + 5 * number
        clip = Clip(**record)
        assert record["provenance"]["frames"] == frames.tolist()
        assert clip.rgb.shape == (4, 8, 8, 3)
        np.testing.assert_array_equal(clip.rgb[:, 0, 0, 1], frames)
        assert clip.depth is not None
        np.testing.assert_allclose(clip.depth[:, 3, 3], 1 + frames / 10, rtol=1e-6)
        np.testing.assert_array_equal(clip.actions, np.stack([[0, *frames[1:]], [0, *-frames[1:]]], 1))
    assert summary["depth"] == pytest.approx([1.0, 1 + 35 / 10]) and summary["depth_unit"] == "metres"
    assert summary["action_dim"] == 2 and summary["actions"]["action_count"] == 15


@settings(max_examples=20)
@given(
    st.sampled_from([5.0, 7.5, 10, 24, 29.97, 30]),
    st.sampled_from([0.0, 1, 2, 3, 5]),
    st.integers(2, 6),
    st.integers(0, 2**32 - 1),
)
def test_joined_actions_are_the_sums_over_the_frames_between(fps: float, rate: float, count: int, seed: int) -> None:
    actions = np.random.default_rng(seed).normal(size=(160, 3)).astype(np.float32)
    made = episode("a", 160, fps=fps, timestamps=np.arange(160) / fps, actions=actions)
    kept, summary = clips(made, ClipConfig(WindowConfig(frames=count, rate=rate, hop=5), 8, 1))
    assert len(kept) == summary["windows"]["kept"] > 0
    for record in (kept[0], kept[-1]):
        at = record["provenance"]["frames"]
        between = [actions[before + 1 : after + 1].sum(0) for before, after in pairwise(at)]
        np.testing.assert_allclose(record["actions"], [np.zeros(3), *between], rtol=1e-4, atol=1e-4)


def test_uneven_frames_are_sampled_by_time_and_say_so() -> None:
    times = np.concatenate([np.arange(20) / 10, 2 + np.arange(20) / 5])
    made = episode("a", timestamps=times)
    kept, _ = clips(made)
    assert [record["provenance"]["frames"] for record in kept[:1]] == [[0, 5, 10, 15]]
    slow = kept[-1]["provenance"]
    np.testing.assert_allclose(np.diff(slow["times"]), 0.5, atol=0.11)
    np.testing.assert_allclose(slow["times"], times[slow["frames"]])
    assert "times" not in kept[0]["provenance"]
    stacked, summary = clips(made, ClipConfig(CONFIG.windows, 8, 6, actions=ActionConfig(compose="stack")))
    assert summary["windows"]["uneven"] and {record["actions"].shape[1] for record in stacked} == {10}


@settings(max_examples=20)
@given(st.lists(st.integers(1, 119), max_size=5), st.sampled_from([0.0, 2.0, 3.0]), st.booleans())
def test_no_clip_reaches_across_a_cut(cuts: list[int], rate: float, within: bool) -> None:
    edges = [0, *sorted(set(cuts)), 120]
    shots = list(pairwise(edges))
    made = episode("a", 120, segments=(Segment(10, 50, "reach"), Segment(50, 110, "grasp")))
    config = ClipConfig(WindowConfig(frames=4, rate=rate, within_segments=within), 8, 1)
    kept, summary = clips(made, config, shots=shots)
    assert len(kept) == sum(summary["windows"].values())
    for record in kept:
        at = record["provenance"]["frames"]
        assert not any(at[0] < cut <= at[-1] for cut in edges[1:-1])
        assert not within or (at[0] >= 10 and at[-1] < 50) or (at[0] >= 50 and at[-1] < 110)


def test_without_depth_a_clip_has_none() -> None:
    unread = ClipConfig(CONFIG.windows, 8, 6, recorded_depth=False)
    for made, config in ((episode("a"), CONFIG), (episode("a", depth=True), unread)):
        kept, summary = clips(made, config)
        assert kept[0]["depth"] is None and summary["depth"] is None and summary["depth_unit"] is None
        assert kept[0]["provenance"]["depth_unit"] == ""


def test_estimated_depth_is_read_from_its_parts() -> None:
    maps = np.arange(40, dtype=np.float16)[:, None, None] + np.ones((40, 5, 5), np.float16)
    parts = Records({"first": first, "depth": maps[first : first + 7], "unit": "relative"} for first in range(0, 40, 7))
    kept, _ = clips(episode("a"), depth=parts)
    for record in kept:
        np.testing.assert_array_equal(record["depth"][:, 0, 0], np.array(record["provenance"]["frames"]) + 1)
        assert record["provenance"]["depth_unit"] == "relative"
    with pytest.raises(EpisodeError, match=r"depth: no map of frame 35 of episode a"):
        clips(episode("a"), depth=Records(parts[:5]))


def test_rgb_depth_and_tracks_follow_one_fit() -> None:
    """Pictures are 16 × 12: a crop leaves out an eighth at either side, and bars cover an eighth above and below."""
    xs = np.array([0.05, 0.125, 0.5, 0.95])
    points = np.stack([np.broadcast_to(xs[:, None], (4, 40)), np.zeros((4, 40))], -1).astype(np.float16)
    tracks = Records([{"first": 0, "points": points, "visible": np.ones((4, 40), bool)}])
    made = {
        fit: clips(episode("a", depth=True), replace(CONFIG, fit=fit), tracks=tracks)
        for fit in ("crop", "pad", "stretch")
    }
    shown = {fit: sorted({*np.round(kept[0]["tracks"][:, 0, 0], 3).tolist()}) for fit, (kept, _) in made.items()}
    assert shown["crop"] == [0.0, 0.5]
    assert shown["pad"] == shown["stretch"] == pytest.approx([0.05, 0.125, 0.5, 0.95], abs=1e-3)
    assert (made["pad"][0][0]["tracks"][..., 1] == 0.125).all()
    for fit, (kept, summary) in made.items():
        bars = np.zeros((8, 8), bool)
        bars[[0, -1]] = fit == "pad"
        assert (kept[0]["depth"][:, bars] == 0).all() and (kept[0]["depth"][:, ~bars] >= 1).all()
        assert (kept[0]["rgb"][:, bars] == 0).all() and (kept[0]["rgb"][:, ~bars, 0] == 100).all()
        assert summary["depth"] == pytest.approx([1.0, 1 + 35 / 10])
        assert kept[0]["provenance"]["fit"] == fit and summary["fit"].startswith("16 × 12")


def test_tracks_are_those_of_the_windows_shot() -> None:
    seen = np.ones((3, 20), bool)
    seen[2, :18] = False
    points = np.broadcast_to(np.arange(20)[None, :, None], (3, 20, 2)).astype(np.float16)
    shots = [(0, 20), (20, 40)]
    records = Records({"first": first, "points": points, "visible": seen} for first, _ in shots)
    kept, summary = clips(episode("a"), STRETCHED, shots=shots, tracks=records)
    assert summary["windows"] == {"kept": 2}
    for record, first in zip(kept, (0, 20), strict=True):
        assert record["tracks"].shape == (6, 4, 2) and record["visible"].all()
        np.testing.assert_array_equal(record["tracks"][0, :, 0], np.array(record["provenance"]["frames"]) - first)
    seen[:, 0] = False
    kept, summary = clips(episode("a"), shots=shots, tracks=records)
    assert not kept and summary["windows"] == {"kept": 0, "no track": 2}


def test_labels_are_the_tasks_and_the_segments() -> None:
    config = ClipConfig(CONFIG.windows, 8, 6, categories=CategoryConfig((("pick*", "simple"),)))
    kept, _ = clips(episode("a"), config, motion=np.arange(40.0), scene="kitchen")
    named = {"task": "pick a cup", "difficulty": "simple", "scene": "kitchen"}
    assert clip_labels(kept[0]) == named | {"segment": "reach", "skill": "unknown"}
    assert clip_labels(kept[4]) == named | {"segment": "grasp", "skill": "Grasp"}
    assert [record["provenance"]["segment"] for record in kept] == ["reach", "reach", "reach", "grasp", "grasp"]
    assert kept[0]["provenance"]["motion"] == np.mean(np.arange(1, 16))
    unnamed, _ = clips(episode("a", task=""), config)
    assert unnamed[4]["task"] == "grasp"
    by_skill = ClipConfig(CONFIG.windows, 8, 6, categories=CategoryConfig((("Grasp", "difficult"),)))
    words = [record["provenance"]["difficulty"] for record in clips(episode("a", task="tidy up"), by_skill)[0]]
    assert words == ["unknown"] * 3 + ["difficult"] * 2


def test_success_is_the_data_sets_by_frame_or_for_the_whole() -> None:
    by_frame = {"success": [False] * 39 + [True]}
    assert [bool(record["success"][-1]) for record in clips(episode("a", meta=by_frame))[0]] == [False] * 5
    kept, summary = clips(episode("a", meta={"success": True}))
    assert kept[0]["success"].all() and summary["success"] == 5


def test_overlapping_windows_read_each_frame_and_the_tracks_of_a_shot_once() -> None:
    frames: list[int] = []
    tracks: list[int] = []

    class CountedPictures(Pictures):
        def read(self, indices: Any) -> np.ndarray:
            frames.extend(indices)
            return super().read(indices)

    class CountedRecords(Records):
        def __getitem__(self, index: Any) -> Any:
            tracks.append(index)
            return super().__getitem__(index)

    seen = {"points": np.zeros((3, 20, 2), np.float16), "visible": np.ones((3, 20), bool)}
    shots = [(0, 20), (20, 40)]
    records = CountedRecords({"first": first} | seen for first, _ in shots)
    config = ClipConfig(WindowConfig(frames=4, rate=0), 8, 6, fit="pad")
    kept, _ = clips(episode("a", cameras={"front": CountedPictures(40)}), config, shots=shots, tracks=records)
    assert len(kept) == 34 and frames == list(range(40)) and tracks == [0, 1]


@given(st.sampled_from([5.0, 10.0, 29.97]), st.floats(0.5, 5), st.integers(2, 12), st.integers(1, 200))
@settings(max_examples=20)
def test_an_episode_as_long_as_a_window_is_said_to_take_gives_one(
    fps: float, rate: float, frames: int, count: int
) -> None:
    config = ClipConfig(WindowConfig(frames, rate, most_gap=3), 8, 1)
    made = episode("a", count, fps=fps, timestamps=np.arange(count) / fps)
    kept, summary = clips(made, config)
    needed = int(summary["short"]["window"].partition(" take ")[2].split()[0])
    assert bool(kept) == (count >= needed)
    more = WindowConfig(frames, min(fps, 2 * rate), most_gap=3)
    assert more.rate == rate or clips(made, ClipConfig(more, 8, 1))[1]["windows"]["kept"] >= len(kept)


@pytest.mark.parametrize(
    ("count", "config", "shots", "short"),
    [
        (
            5,
            CONFIG,
            [],
            (1, 5, "4 frames at 2 Hz take 16 of 10 fps", "raise --windows.rate or lower --windows.frames"),
        ),
        (
            5,
            ClipConfig(WindowConfig(frames=8, rate=0), 8, 6),
            [(0, 3), (3, 5)],
            (2, 3, "8 frames take 8 of 10 fps", "lower --windows.frames"),
        ),
        (
            20,
            CONFIG,
            [(0, 9), (9, 20)],
            (
                2,
                11,
                "4 frames at 2 Hz take 16 of 10 fps",
                "the video was cut between shots, so --shots none if it was not edited, or raise --windows.rate or "
                "lower --windows.frames",
            ),
        ),
    ],
)
def test_a_short_episode_gives_nothing_and_says_so(
    count: int, config: ClipConfig, shots: list[tuple[int, int]], short: tuple[int, int, str, str]
) -> None:
    kept, summary = clips(episode("a", count=count), config, shots=shots)
    assert not kept and summary["windows"] == {"kept": 0}
    assert summary["short"] == dict(zip(("spans", "longest", "window", "cure"), short, strict=True))


@pytest.mark.parametrize(
    ("config", "annotations", "match"),
    [
        (ClipConfig(camera="side"), {}, r"no 'side'; it has front"),
        (CONFIG, {"motion": np.zeros(39)}, r"motion: 39 values for 40 frames"),
    ],
)
def test_what_does_not_fit_is_named(config: ClipConfig, annotations: dict[str, Any], match: str) -> None:
    with pytest.raises(EpisodeError, match=match):
        clips(episode("a"), config, **annotations)
